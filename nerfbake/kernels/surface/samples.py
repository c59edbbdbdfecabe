"""A function sampled in bricks of 4^3 around a surface, and rays through it.

Samples are at integer positions of a lattice. top (X, Y, Z) int32 is the number of the brick of each 4^3 samples, in
raster order, or NONE; values (b, 64) float32, x-major. A sample without a brick is outside.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Coords, Floats, Singles
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.march.lines import part_in_box
from nerfbake.kernels.parallel import on_every_core

NONE = -1
BITS = 2
EDGE = 1 << BITS
CUBE = EDGE**3
_STEP = 0.5  # of the lattice, between two samples of a ray

Top = npt.NDArray[np.int32]


def brick_places(top: Top) -> Coords:
    """(b, 3) int32: the place of each brick, in bricks."""
    return np.ascontiguousarray(np.argwhere(top >= 0), np.int32)


@compiled()
def mark_bricks(depth: Singles, pose: Floats, optics: Floats, lattice: Floats, reach: float, held: Bits) -> None:
    """Mark the bricks with samples up to `reach` from the points that a picture of depths shows, along each axis.

    depth (H, W) in world units, inf for none; lattice (3, 4): lattice of the world.
    """
    H, W = depth.shape
    for y in range(H):
        for x in range(W):
            far = np.float64(depth[y, x])
            if far == np.inf:
                continue
            across, up = (x + 0.5 - optics[2]) / optics[0], -(y + 0.5 - optics[3]) / optics[1]
            far /= np.sqrt(across * across + up * up + 1)
            w0 = pose[0, 3] + far * (pose[0, 0] * across + pose[0, 1] * up - pose[0, 2])
            w1 = pose[1, 3] + far * (pose[1, 0] * across + pose[1, 1] * up - pose[1, 2])
            w2 = pose[2, 3] + far * (pose[2, 0] * across + pose[2, 1] * up - pose[2, 2])
            q0 = lattice[0, 0] * w0 + lattice[0, 1] * w1 + lattice[0, 2] * w2 + lattice[0, 3]
            q1 = lattice[1, 0] * w0 + lattice[1, 1] * w1 + lattice[1, 2] * w2 + lattice[1, 3]
            q2 = lattice[2, 0] * w0 + lattice[2, 1] * w1 + lattice[2, 2] * w2 + lattice[2, 3]
            a0, b0 = _bricks_near(q0, reach, held.shape[0])
            a1, b1 = _bricks_near(q1, reach, held.shape[1])
            a2, b2 = _bricks_near(q2, reach, held.shape[2])
            for i in range(a0, b0):
                for j in range(a1, b1):
                    for k in range(a2, b2):
                        held[i, j, k] = True


@compiled(merged=True)
def _bricks_near(q: float, reach: float, count: int) -> Any:
    low, high = np.ceil(q - reach), np.floor(q + reach)
    return max(int(low) >> BITS, 0), min((int(high) >> BITS) + 1, count)


@compiled(merged=True)
def place_of(places: Coords, brick: int, cell: int) -> Any:
    """Return x, y, z of the sample in this slot, 0 to 63, of a brick."""
    return (
        places[brick, 0] * EDGE + (cell >> 2 * BITS),
        places[brick, 1] * EDGE + (cell >> BITS & EDGE - 1),
        places[brick, 2] * EDGE + (cell & EDGE - 1),
    )


@compiled(merged=True)
def slot_of(x: int, y: int, z: int) -> int:
    """Return the slot of a sample in its brick."""
    low = EDGE - 1
    return (x & low) << 2 * BITS | (y & low) << BITS | z & low


@compiled(merged=True)
def sample_at(top: Top, values: Singles, x: int, y: int, z: int) -> float:
    """The value of one sample; inf where there is none."""
    i, j, k = x >> BITS, y >> BITS, z >> BITS
    if not (0 <= i < top.shape[0] and 0 <= j < top.shape[1] and 0 <= k < top.shape[2]):
        return np.inf
    brick = top[i, j, k]
    if brick < 0:
        return np.inf
    return np.float64(values[brick, slot_of(x, y, z)])


@on_every_core
@compiled()
def least_along_rays(
    core: int,
    cores: int,
    top: Top,
    values: Singles,
    lattice: Floats,
    pose: Floats,
    optics: Floats,
    outside: float,
    out: Singles,
) -> None:
    """Fill out (H, W) with the smallest value along each ray of a pinhole; `outside` where it meets no brick."""
    top, values, lattice, pose, optics, out = borrowed((top, values, lattice, pose, optics, out))
    H, W = out.shape
    for y in range(core, H, cores):
        for x in range(W):
            out[y, x] = _least(top, values, lattice, pose, optics, outside, x, y)


@compiled()
def _least(
    top: Top, values: Singles, lattice: Floats, pose: Floats, optics: Floats, outside: float, column: int, row: int
) -> float:
    across, up = (column + 0.5 - optics[2]) / optics[0], -(row + 0.5 - optics[3]) / optics[1]
    w0 = pose[0, 0] * across + pose[0, 1] * up - pose[0, 2]
    w1 = pose[1, 0] * across + pose[1, 1] * up - pose[1, 2]
    w2 = pose[2, 0] * across + pose[2, 1] * up - pose[2, 2]
    d0 = lattice[0, 0] * w0 + lattice[0, 1] * w1 + lattice[0, 2] * w2
    d1 = lattice[1, 0] * w0 + lattice[1, 1] * w1 + lattice[1, 2] * w2
    d2 = lattice[2, 0] * w0 + lattice[2, 1] * w1 + lattice[2, 2] * w2
    scale = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    d0, d1, d2 = d0 / scale, d1 / scale, d2 / scale
    e0 = lattice[0, 0] * pose[0, 3] + lattice[0, 1] * pose[1, 3] + lattice[0, 2] * pose[2, 3] + lattice[0, 3]
    e1 = lattice[1, 0] * pose[0, 3] + lattice[1, 1] * pose[1, 3] + lattice[1, 2] * pose[2, 3] + lattice[1, 3]
    e2 = lattice[2, 0] * pose[0, 3] + lattice[2, 1] * pose[1, 3] + lattice[2, 2] * pose[2, 3] + lattice[2, 3]
    high = top.shape[0] * EDGE - 1.0, top.shape[1] * EDGE - 1.0, top.shape[2] * EDGE - 1.0
    start, end = part_in_box((0.0, 0.0, 0.0), high, (e0, e1, e2), (d0, d1, d2), np.inf)
    least, t = outside, start
    while t < end:
        q0, q1, q2 = e0 + t * d0, e1 + t * d1, e2 + t * d2
        x, y, z = int(np.floor(q0)), int(np.floor(q1)), int(np.floor(q2))
        i, j, k = max(x, 0) >> BITS, max(y, 0) >> BITS, max(z, 0) >> BITS
        if top[i, j, k] < 0:
            t = max(t, min(_exit(e0, d0, i), _exit(e1, d1, j), _exit(e2, d2, k))) + 0.01
            continue
        f0, f1, f2 = q0 - x, q1 - y, q2 - z
        value = 0.0
        for corner in range(8):
            a, b, c = corner >> 2, corner >> 1 & 1, corner & 1
            weight = (f0 if a else 1 - f0) * (f1 if b else 1 - f1) * (f2 if c else 1 - f2)
            value += weight * min(sample_at(top, values, x + a, y + b, z + c), outside)
        least = min(least, value)
        t += _STEP
    return least


@compiled(merged=True)
def _exit(e: float, d: float, brick: int) -> float:
    """Where a ray leaves a brick along one axis."""
    if d == 0:
        return np.inf
    return ((brick + 1) * EDGE - e) / d if d > 0 else (brick * EDGE - e) / d


@on_every_core
@compiled()
def blur(core: int, cores: int, top: Top, places: Coords, values: Singles, share: float, out: Singles) -> None:
    """Fill out (b, 64): each value moved by `share` towards the mean of the 3^3 samples around it, weighted 1 2 1."""
    top, places, values, out = borrowed((top, places, values, out))
    for brick in range(core, len(places), cores):
        for cell in range(CUBE):
            x, y, z = place_of(places, brick, cell)
            total, weights = 0.0, 0.0
            for other in range(27):
                i, j, k = other // 9 - 1, other // 3 % 3 - 1, other % 3 - 1
                value = sample_at(top, values, x + i, y + j, z + k)
                if value != np.inf:
                    weight = (2.0 - abs(i)) * (2 - abs(j)) * (2 - abs(k))
                    total += weight * value
                    weights += weight
            out[brick, cell] = (1 - share) * values[brick, cell] + share * total / weights


@on_every_core
@compiled()
def spread(core: int, cores: int, top: Top, places: Coords, held: Bits, reach: int, out: Bits) -> None:
    """Fill out (b, 64): whether any sample up to `reach` away along each axis is held (b, 64)."""
    for brick in range(core, len(places), cores):
        for cell in range(CUBE):
            x, y, z = place_of(places, brick, cell)
            out[brick, cell] = _any_held(top, held, x, y, z, reach)


@compiled(merged=True)
def _any_held(top: Top, held: Bits, x: int, y: int, z: int, reach: int) -> bool:
    for i in range(max(x - reach, 0), min(x + reach + 1, top.shape[0] * EDGE)):
        for j in range(max(y - reach, 0), min(y + reach + 1, top.shape[1] * EDGE)):
            for k in range(max(z - reach, 0), min(z + reach + 1, top.shape[2] * EDGE)):
                brick = top[i >> BITS, j >> BITS, k >> BITS]
                if brick >= 0 and held[brick, slot_of(i, j, k)]:
                    return True
    return False
