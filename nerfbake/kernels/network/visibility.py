"""March rays through bricks of cells with a density: how much light each cell absorbs, and which cameras see it.

The bricks are those of kernels.fit.bricks, without wide cells. Results are maxima and sums of integers, so they do not
depend on the order of the rays.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.fit.bricks import Whole
from nerfbake.kernels.fit.hull import part_between
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.march.lines import cell_at, exits, line_of, next_cell

LIGHT = 1 << 20  # the sums of weights count in these parts of a ray's light
CUT = 1e-3  # transmittance below which a ray ends
_LEVELS = 255  # of a transmittance in a byte


class SeenBricks(NamedTuple):
    """Bricks and densities that rays are marched through.

    top, slots, first, low, size  as in kernels.fit.bricks.BrickGrid
    sigma  (n,) densities of the cells per world unit
    """

    top: npt.NDArray[np.int32]
    slots: npt.NDArray[np.int16]
    first: npt.NDArray[np.int32]
    sigma: Singles
    low: Floats
    size: Floats


class CellLight(NamedTuple):
    """What rays find; each may be empty, and is then not computed.

    largest  (n,): the largest weight of each cell, the share of a ray's light that it absorbs
    total    (n,): the sum of its weights, in 1 / LIGHT
    """

    largest: Singles
    total: Ints


@compiled()
def see_cells(
    bricks: SeenBricks,
    eye: Floats,
    directions: Floats,
    near: float,
    light: CellLight,
    through: npt.NDArray[np.uint8],
) -> None:
    """March the rays of one camera, and raise `light` and `through` by what they find.

    eye (3,) and unit directions (m, 3) in the world; rays begin at the distance `near`. through (n,): the largest
    transmittance, 0 to 255, of the rays where they enter a cell, at least 1; or empty.
    """
    bricks, eye, directions, light, through = borrowed((bricks, eye, directions, light, through))
    shells = len(bricks.low)
    enter, leave = np.empty(shells), np.empty(shells)
    for ray in range(len(directions)):
        _see(bricks, eye, directions, ray, near, light, through, enter, leave)


@compiled(merged=True)
def _see(
    bricks: SeenBricks,
    eye: Floats,
    directions: Floats,
    ray: Whole,
    near: float,
    light: CellLight,
    through: npt.NDArray[np.uint8],
    enter: Floats,
    leave: Floats,
) -> None:
    """March a ray. It meets each shell at most twice: before and behind the smaller cubes."""
    r = bricks.top.shape[1]
    edge, shells, left = 8 * r, len(bricks.low), 1.0
    deepest = shells
    for shell in range(shells - 1, -1, -1):
        start, end = near, np.inf
        for axis in range(3):
            step = directions[ray, axis] / bricks.size[shell, axis]
            place = (eye[axis] - bricks.low[shell, axis]) / bricks.size[shell, axis]
            start, end = part_between(place, 1 / step if step != 0 else np.inf, edge, start, end)
        enter[shell], leave[shell] = start, end
        if start >= end:
            break
        deepest = shell
    for part in range(2 * (shells - deepest) - 1 if deepest < shells else 0):
        inward = part < shells - 1 - deepest
        shell = shells - 1 - part if inward else 2 * deepest + part - shells + 1
        t = enter[shell] if inward or shell == deepest else leave[shell - 1]
        end = enter[shell - 1] if inward else leave[shell]
        if t >= end:
            continue
        size, low = bricks.size[shell], bricks.low[shell]
        way = directions[ray, 0] / size[0], directions[ray, 1] / size[1], directions[ray, 2] / size[2]
        line = line_of(((eye[0] - low[0]) / size[0], (eye[1] - low[1]) / size[1], (eye[2] - low[2]) / size[2]), way)
        x, y, z = cell_at(line, t, (0, 0, 0), (edge - 1, edge - 1, edge - 1))
        while t < end:
            b0, b1, b2 = x >> 3, y >> 3, z >> 3
            brick = np.int64(bricks.top[shell * r + b0, b1, b2])
            slot: Any = np.int64(-2)
            width: Whole = 1
            corner = x, y, z
            if brick >= 0:
                slot = np.int64(bricks.slots[brick, (x & 7) << 6 | (y & 7) << 3 | z & 7])
                if slot == -1:  # an empty block of 2^3 cells
                    width, corner = 2, (x & ~1, y & ~1, z & ~1)
            else:  # skip the empty bricks up to the known distance, in all directions
                away: Whole = max(-brick, 1)
                width = (2 * away - 1) << 3
                corner = (b0 - away + 1) << 3, (b1 - away + 1) << 3, (b2 - away + 1) << 3
            crossings = exits(corner, width, line)
            ahead = max(min(crossings), t)
            if slot >= 0:
                cell = np.int64(bricks.first[brick]) + (slot >> 1)
                whole, rest = compiled_exp_parts(-np.float64(bricks.sigma[cell]) * (min(ahead, end) - t))
                behind = left * (whole + whole * rest)
                weight = left - behind
                if len(light.largest):
                    light.largest[cell] = max(light.largest[cell], np.float32(weight))
                if len(light.total):
                    light.total[cell] += np.int64(weight * LIGHT)
                if len(through):
                    through[cell] = max(through[cell], np.uint8(max(left * _LEVELS, 1.0)))
                left = behind
                if left < CUT:
                    return
            t = ahead
            (x, y, z), _ = next_cell(corner, width, crossings, line, t)
            if not (0 <= x < edge and 0 <= y < edge and 0 <= z < edge):
                break
