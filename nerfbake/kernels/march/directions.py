"""Directions of rays in cells with their basis functions, and the largest weight of each leaf over all rays.

A leaf whose largest weight is small may be removed without a visible difference.
"""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.compiled import compiled_exp_parts, compiled_fill_basis
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.march.cells import EMPTY, Cells, descend, lowest
from nerfbake.kernels.march.lines import cell_at, cells_at_corners, exits, is_within, line_in_box, next_cell
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
    first, last = cells_at_corners(box)
    for ray in range(len(directions)):
        line, start, end, scale = line_in_box(box, origin, directions, ray, np.inf)
        through, t, end, world = 1.0, 0.0, end - start, 1 / scale
        cell = cell_at(line, t, first, last)
        while t < end:
            slot, level = descend(cells, cell)
            low, width = lowest(cells, level, cell), cells.width[level]
            crossings = exits(low, width, line)
            ahead = max(min(crossings), t)
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
            cell, axis = next_cell(low, width, crossings, line, t)
            if not is_within(cell, axis, first, last):
                break
        alpha[ray] = 1 - through
