"""Ray marching through a tree of cells that sample a smooth field, with interpolation between their centres.

Density is trilinear; an empty cell has density 0. Coefficients are trilinear too, weighted by density: empty space has
no visible colour. The ray crosses the cubes between eight centres. Along the ray, density is a cubic within each cube,
and two Gauss points integrate a cubic exactly. Empty regions are crossed one cell of the tree at a time.
"""

from __future__ import annotations

from math import sqrt
from typing import Any

import numpy as np

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.march.cells import EMPTY, Cells, descend
from nerfbake.kernels.march.traversal import (
    _BLOCK,
    containing_cell,
    next_cell,
    sigmoid_of,
    span,
    sums,
)
from nerfbake.kernels.parallel import on_every_core

GAUSS = 0.5 - 0.5 / sqrt(3)  # of an interval: its first Gauss point; the second is as far from the end


@on_every_core
@compiled()
def march_smooth(
    core: int,
    cores: int,
    cells: Cells,
    values: Singles,
    densities: Singles,
    box: Floats,
    origin: Floats,
    directions: Floats,
    stop: Floats,
    basis: Singles,
    cut: float,
    out: Singles,
) -> None:
    """Like traversal.march(), for interpolated cells.

    Positions count from the centre of the first cell, and the box extends from centre to centre.
    """
    cells, values, densities, box, origin, directions, stop, basis, out = borrowed(
        (cells, values, densities, box, origin, directions, stop, basis, out)
    )
    low0, low1, low2 = box[0, 0], box[0, 1], box[0, 2]
    high0, high1, high2 = box[1, 0] - 1, box[1, 1] - 1, box[1, 2] - 1
    blocks = (len(directions) + _BLOCK - 1) // _BLOCK
    for block in range(core, blocks, cores):
        corners = np.zeros((8, 4))
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, len(directions))):
            start, end, scale = span(box, origin, directions, ray, stop[ray])
            d0, d1, d2 = directions[ray, 0] / scale, directions[ray, 1] / scale, directions[ray, 2] / scale
            o0, o1, o2 = origin[0] + start * d0, origin[1] + start * d1, origin[2] + start * d2
            through, red, green, blue, far = 1.0, 0.0, 0.0, 0.0, 0.0
            t, end, world, fresh = 0.0, end - start, 1 / scale, 8
            x, y, z = (
                containing_cell(o0, low0, high0),
                containing_cell(o1, low1, high1),
                containing_cell(o2, low2, high2),
            )
            while t < end:
                # The cube from x to x + 1 or, in an empty cell of the tree, all cubes between the centres inside it.
                l0, l1, l2, width = x, y, z, 1
                slot, level = _slot(cells, x, y, z)
                if slot == EMPTY:
                    edge = int(cells.width[level])
                    if edge > 1 and cells.edge > max(x, y, z) and min(x, y, z) >= 0:
                        e0, e1, e2 = x // edge * edge, y // edge * edge, z // edge * edge
                        if max(x - e0, y - e1, z - e2) < edge - 1:
                            l0, l1, l2, width, fresh = e0, e1, e2, edge - 1, 8
                exit0 = ((l0 + width if d0 > 0 else l0) - o0) / d0 if d0 != 0 else np.inf
                exit1 = ((l1 + width if d1 > 0 else l1) - o1) / d1 if d1 != 0 else np.inf
                exit2 = ((l2 + width if d2 > 0 else l2) - o2) / d2 if d2 != 0 else np.inf
                ahead = max(min(exit0, exit1, exit2), t)
                if width == 1:
                    _fetch(cells, values, densities, basis, ray, x, y, z, fresh, corners)
                    length = min(ahead, end) - t
                    for point in range(2):
                        at = t + length * (GAUSS if point == 0 else 1 - GAUSS)
                        sigma, r, g, b = _between(corners, o0 + at * d0 - x, o1 + at * d1 - y, o2 + at * d2 - z)
                        if sigma > 0:
                            whole, rest = compiled_exp_parts(-sigma * 0.5 * length * world)
                            kept = whole + whole * rest
                            lost = through * (1 - kept)
                            red += lost * sigmoid_of(r / sigma)
                            green += lost * sigmoid_of(g / sigma)
                            blue += lost * sigmoid_of(b / sigma)
                            far += lost * (start + at) * world
                            through *= kept
                    if through < cut:
                        break
                t = ahead
                x, y, z, axis = next_cell(l0, l1, l2, width, exit0, exit1, exit2, o0, o1, o2, d0, d1, d2, t)
                if not (low0 <= x <= high0 if axis == 0 else low1 <= y <= high1 if axis == 1 else low2 <= z <= high2):
                    break
                if width == 1:
                    # The corners that the next cube does not share with this one, as a bit of their numbers.
                    upward = d0 > 0 if axis == 0 else d1 > 0 if axis == 1 else d2 > 0
                    fresh = 4 >> axis if upward else -(4 >> axis)
            out[ray, 0], out[ray, 1], out[ray, 2], out[ray, 3], out[ray, 4] = red, green, blue, 1 - through, far


@compiled(merged=True)
def _slot(cells: Cells, x: int, y: int, z: int) -> Any:
    if 0 <= x < cells.edge and 0 <= y < cells.edge and 0 <= z < cells.edge:
        return descend(cells, x, y, z)
    return np.int64(EMPTY), np.int64(0)


@compiled(merged=True)
def _fetch(
    cells: Cells,
    values: Singles,
    densities: Singles,
    basis: Singles,
    ray: int,
    x: int,
    y: int,
    z: int,
    fresh: int,
    corners: Floats,
) -> None:
    """Fill the corners 4 dx + 2 dy + dz of a cube: density, and density times the sums of the coefficients.

    fresh: 8 reads all corners. 4, 2 or 1 reads those on the far side along x, y or z, because the previous cube was
    below this one. A negative number reads those on the near side, because it was above.
    """
    axis = abs(fresh) & 7
    for corner in range(8):
        # Copy shared corners before they are overwritten: upward after a step up, downward after a step down.
        number = corner if fresh > 0 else 7 - corner
        if axis and (number & axis == 0) == (fresh > 0):
            for k in range(4):  # a loop: numba would copy slices first, in case they overlap
                corners[number, k] = corners[number ^ axis, k]
            continue
        slot, _ = _slot(cells, x + (number >> 2), y + (number >> 1 & 1), z + (number & 1))
        sigma, r, g, b = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        if slot != EMPTY:
            sigma = densities[-2 - slot]
            r, g, b = sums(values, -2 - slot, basis, ray)
        corners[number, 0], corners[number, 1] = sigma, sigma * r
        corners[number, 2], corners[number, 3] = sigma * g, sigma * b


@compiled(merged=True)
def _between(corners: Floats, f0: float, f1: float, f2: float) -> Any:
    """Interpolate the four values of the corners at a position in their cube, 0 to 1 along each axis."""
    sigma, r, g, b = 0.0, 0.0, 0.0, 0.0
    for corner in range(8):
        weight = (f0 if corner & 4 else 1 - f0) * (f1 if corner & 2 else 1 - f1) * (f2 if corner & 1 else 1 - f2)
        sigma += weight * corners[corner, 0]
        r += weight * corners[corner, 1]
        g += weight * corners[corner, 2]
        b += weight * corners[corner, 3]
    return sigma, r, g, b
