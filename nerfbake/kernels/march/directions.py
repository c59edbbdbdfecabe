"""Directions of rays in cells with their basis functions, and the largest weight of each leaf over all rays.

A leaf whose largest weight is small may be removed without a visible difference.
"""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.compiled import compiled_exp_parts, compiled_fill_basis
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.march.cells import EMPTY, Cells, descend, lowest
from nerfbake.kernels.march.traversal import containing_cell, exits, next_cell, span
from nerfbake.kernels.parallel import on_every_core

_BLOCK = 1024  # rays that a core processes before it takes the next block


def rotate_and_project(looks: Floats, turn: Floats, axes: Floats, B: int) -> tuple[Floats, Singles]:
    """(m, 3) turn @ each direction in looks (m, 3), and (m, B) the spherical harmonics at axes @ each direction.

    turn, axes (3, 3). The result equals that of maths.affine.rotate() and march.sh.sh_basis() to the bit, in an eighth
    of the time.
    """
    ways, basis = np.empty(looks.shape), np.empty((len(looks), B), np.float32)
    _face(looks, turn, axes, ways, basis)
    return ways, basis


def look_and_project(x: Floats, y: Floats, pose: Floats, turn: Floats, axes: Floats, B: int) -> tuple[Floats, Singles]:
    """Return rotate_and_project() of the unit directions through all pixels of a pinhole camera, rows from the top.

    x (W,), y (H,): where the rays of columns and rows cross the plane at distance 1. pose (3, 3): columns right,
    up and back. The result equals that of Camera.rays() to the bit, without an array of these directions.
    """
    count = len(x) * len(y)
    ways, basis = np.empty((count, 3)), np.empty((count, B), np.float32)
    _look(x, y, np.ascontiguousarray(pose), turn, axes, ways, basis)
    return ways, basis


@on_every_core
@compiled()
def _look(
    core: int, cores: int, x: Floats, y: Floats, pose: Floats, turn: Floats, axes: Floats, ways: Floats, basis: Singles
) -> None:
    x, y, pose, turn, axes, ways, basis = borrowed((x, y, pose, turn, axes, ways, basis))
    B, width = basis.shape[1], len(x)
    for row in range(core, len(y), cores):
        look, functions = np.empty(3), np.empty(B)
        for column in range(width):
            for axis in range(3):
                look[axis] = (x[column] * pose[axis, 0] - pose[axis, 2]) + y[row] * pose[axis, 1]
            length = np.sqrt((look[0] * look[0] + look[1] * look[1]) + look[2] * look[2])
            turn_look(
                look[0] / length,
                look[1] / length,
                look[2] / length,
                turn,
                axes,
                ways,
                basis,
                row * width + column,
                functions,
            )


@on_every_core
@compiled()
def _face(core: int, cores: int, looks: Floats, turn: Floats, axes: Floats, ways: Floats, basis: Singles) -> None:
    looks, turn, axes, ways, basis = borrowed((looks, turn, axes, ways, basis))
    B = basis.shape[1]
    for block in range(core, (len(looks) + _BLOCK - 1) // _BLOCK, cores):
        functions = np.empty(B)
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, len(looks))):
            turn_look(looks[ray, 0], looks[ray, 1], looks[ray, 2], turn, axes, ways, basis, ray, functions)


@compiled(merged=True)
def turn_look(
    x: float,
    y: float,
    z: float,
    turn: Floats,
    axes: Floats,
    ways: Floats,
    basis: Singles,
    ray: int,
    functions: Floats,
) -> None:
    """Write the row of a direction to `ways` and `basis`. functions (B,): a buffer."""
    B = basis.shape[1]
    for axis in range(3):
        ways[ray, axis] = (x * turn[axis, 0] + y * turn[axis, 1]) + z * turn[axis, 2]
    own0 = (x * axes[0, 0] + y * axes[0, 1]) + z * axes[0, 2]
    own1 = (x * axes[1, 0] + y * axes[1, 1]) + z * axes[1, 2]
    own2 = (x * axes[2, 0] + y * axes[2, 1]) + z * axes[2, 2]
    compiled_fill_basis(own0, own1, own2, B, functions)
    for k in range(B):
        basis[ray, k] = functions[k]


@compiled()
def collect_maxima(
    cells: Cells,
    sigma: Singles,
    box: Floats,
    origin: Floats,
    directions: Floats,
    cut: float,
    largest: Singles,
    alpha: Singles,
) -> None:
    """Raise each leaf's largest transmittance times alpha to its maximum along these rays.

    box, origin, directions and cut: see kernels.march.traversal.march(). sigma and largest: (leaves,); the caller must
    not share `largest` between threads. alpha (m,): receives the opacity of each ray. A maximum does not depend on the
    order of the rays, so several threads collect the same values as one.
    """
    cells, sigma, box, origin = borrowed((cells, sigma, box, origin))
    directions, largest, alpha = borrowed((directions, largest, alpha))
    low0, low1, low2 = box[0, 0], box[0, 1], box[0, 2]
    high0, high1, high2 = box[1, 0] - 1, box[1, 1] - 1, box[1, 2] - 1
    for ray in range(len(directions)):
        start, end, scale = span(box, origin, directions, ray, np.inf)
        d0, d1, d2 = directions[ray, 0] / scale, directions[ray, 1] / scale, directions[ray, 2] / scale
        o0, o1, o2 = origin[0] + start * d0, origin[1] + start * d1, origin[2] + start * d2
        i0 = 1 / d0 if d0 != 0 else np.inf
        i1 = 1 / d1 if d1 != 0 else np.inf
        i2 = 1 / d2 if d2 != 0 else np.inf
        through, t, end, world = 1.0, 0.0, end - start, 1 / scale
        x, y, z = containing_cell(o0, low0, high0), containing_cell(o1, low1, high1), containing_cell(o2, low2, high2)
        while t < end:
            slot, level = descend(cells, x, y, z)
            width = cells.width[level]
            l0, l1, l2 = lowest(cells, level, x), lowest(cells, level, y), lowest(cells, level, z)
            exit0, exit1, exit2 = exits(l0, l1, l2, width, o0, o1, o2, d0, d1, d2, i0, i1, i2)
            ahead = max(min(exit0, exit1, exit2), t)
            if slot != EMPTY:
                row = -2 - slot
                whole, rest = compiled_exp_parts(-sigma[row] * (min(ahead, end) - t) * world)
                kept = whole + whole * rest
                weight = np.float32(through * (1 - kept))
                largest[row] = max(largest[row], weight)
                through *= kept
                if through < cut:
                    break
            t = ahead
            x, y, z, axis = next_cell(l0, l1, l2, width, exit0, exit1, exit2, o0, o1, o2, d0, d1, d2, t)
            if not (low0 <= x <= high0 if axis == 0 else low1 <= y <= high1 if axis == 1 else low2 <= z <= high2):
                break
        alpha[ray] = 1 - through
