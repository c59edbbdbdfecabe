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
from nerfbake.kernels.march.lines import (
    Place,
    Triple,
    cell_at,
    cells_at_corners,
    exits,
    is_within,
    line_in_box,
    next_cell,
)
from nerfbake.kernels.march.traversal import _BLOCK, sigmoid_of, sums
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
    first, last = cells_at_corners(box)
    blocks = (len(directions) + _BLOCK - 1) // _BLOCK
    for block in range(core, blocks, cores):
        corners = np.zeros((8, 4))
        for ray in range(block * _BLOCK, min((block + 1) * _BLOCK, len(directions))):
            line, start, end, scale = line_in_box(box, origin, directions, ray, stop[ray])
            o, d = line.origin, line.direction
            through, red, green, blue, far = 1.0, 0.0, 0.0, 0.0, 0.0
            t, end, world, fresh = 0.0, end - start, 1 / scale, 8
            cell = cell_at(line, t, first, last)
            while t < end:
                # The cube from x to x + 1 or, in an empty cell of the tree, all cubes between the centres inside it.
                low, width = cell, 1
                slot, level = _slot(cells, cell)
                if slot == EMPTY:
                    edge = int(cells.width[level])
                    x, y, z = cell
                    if edge > 1 and cells.edge > max(x, y, z) and min(x, y, z) >= 0:
                        e0, e1, e2 = x // edge * edge, y // edge * edge, z // edge * edge
                        if max(x - e0, y - e1, z - e2) < edge - 1:
                            low, width, fresh = (e0, e1, e2), edge - 1, 8
                crossings = exits(low, width, line)
                ahead = max(min(crossings), t)
                if width == 1:
                    _fetch(cells, values, densities, basis, ray, cell, fresh, corners)
                    length = min(ahead, end) - t
                    for point in range(2):
                        at = t + length * (GAUSS if point == 0 else 1 - GAUSS)
                        place = o[0] + at * d[0] - low[0], o[1] + at * d[1] - low[1], o[2] + at * d[2] - low[2]
                        sigma, r, g, b = _between(corners, place)
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
                cell, axis = next_cell(low, width, crossings, line, t)
                if not is_within(cell, axis, first, last):
                    break
                if width == 1:
                    # The corners that the next cube does not share with this one, as a bit of their numbers.
                    upward = d[0] > 0 if axis == 0 else d[1] > 0 if axis == 1 else d[2] > 0
                    fresh = 4 >> axis if upward else -(4 >> axis)
            out[ray, 0], out[ray, 1], out[ray, 2], out[ray, 3], out[ray, 4] = red, green, blue, 1 - through, far


@compiled(merged=True)
def _slot(cells: Cells, cell: Place) -> Any:
    x, y, z = cell
    if 0 <= x < cells.edge and 0 <= y < cells.edge and 0 <= z < cells.edge:
        return descend(cells, cell)
    return np.int64(EMPTY), np.int64(0)


@compiled(merged=True)
def _fetch(
    cells: Cells,
    values: Singles,
    densities: Singles,
    basis: Singles,
    ray: int,
    cell: Place,
    fresh: int,
    corners: Floats,
) -> None:
    """Fill the corners 4 dx + 2 dy + dz of a cube: density, and density times the sums of the coefficients.

    fresh: 8 reads all corners. 4, 2 or 1 reads those on the far side along x, y or z, because the previous cube was
    below this one. A negative number reads those on the near side, because it was above.
    """
    x, y, z = cell
    axis = abs(fresh) & 7
    for corner in range(8):
        # Copy shared corners before they are overwritten: upward after a step up, downward after a step down.
        number = corner if fresh > 0 else 7 - corner
        if axis and (number & axis == 0) == (fresh > 0):
            for k in range(4):  # a loop: numba would copy slices first, in case they overlap
                corners[number, k] = corners[number ^ axis, k]
            continue
        slot, _ = _slot(cells, (x + (number >> 2), y + (number >> 1 & 1), z + (number & 1)))
        sigma, r, g, b = np.float32(0), np.float32(0), np.float32(0), np.float32(0)
        if slot != EMPTY:
            sigma = densities[-2 - slot]
            r, g, b = sums(values, -2 - slot, basis, ray)
        corners[number, 0], corners[number, 1] = sigma, sigma * r
        corners[number, 2], corners[number, 3] = sigma * g, sigma * b


@compiled(merged=True)
def _between(corners: Floats, place: Triple) -> Any:
    """Interpolate the four values of the corners at a place in their cube, 0 to 1 along each axis."""
    f0, f1, f2 = place
    sigma, r, g, b = 0.0, 0.0, 0.0, 0.0
    for corner in range(8):
        weight = (f0 if corner & 4 else 1 - f0) * (f1 if corner & 2 else 1 - f1) * (f2 if corner & 1 else 1 - f2)
        sigma += weight * corners[corner, 0]
        r += weight * corners[corner, 1]
        g += weight * corners[corner, 2]
        b += weight * corners[corner, 3]
    return sigma, r, g, b
