"""Rays through a tree of cells that are samples of something smooth: values between their centres are interpolated.

Density is trilinear, an empty cell's being 0. Coefficients are trilinear too, weighted by density: what is empty has no
colour that could show. Steps are half a cell; empty regions are skipped a tree's cell at a time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import prange

from nerfbake.kernels.cells import EMPTY, Cells, descend, new_path
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.traversal import BLOCK, Doubles, Floats, shuffled, sigmoid, span, sums

STEP = 0.5  # cells; a quarter changes the chair's pictures by less than ...


@compiled(parallel=True)
def march_smooth(
    cells: Cells,
    values: Floats,
    box: Doubles,
    origin: Doubles,
    directions: Doubles,
    stop: Doubles,
    basis: Floats,
    cut: float,
    out: Floats,
) -> None:
    """As traversal.march; the box reaches half a cell beyond what is occupied."""
    blocks, levels, B = (len(directions) + BLOCK - 1) // BLOCK, len(cells.bits), basis.shape[1]
    for turn in prange(blocks):
        block = shuffled(turn, blocks)
        path = new_path(cells)
        for ray in range(block * BLOCK, min((block + 1) * BLOCK, len(directions))):
            start, end, scale = span(box, origin, directions, ray, stop[ray])
            d0, d1, d2 = directions[ray, 0] / scale, directions[ray, 1] / scale, directions[ray, 2] / scale
            o0, o1, o2 = origin[0] + start * d0, origin[1] + start * d1, origin[2] + start * d2
            through, red, green, blue, far = 1.0, 0.0, 0.0, 0.0, 0.0
            k, end = 0, end - start
            while k * STEP < end:
                length = min(STEP, end - k * STEP)
                t = k * STEP + length / 2
                k += 1
                p0, p1, p2 = o0 + t * d0, o1 + t * d1, o2 + t * d2
                x, y, z = int(np.floor(p0)), int(np.floor(p1)), int(np.floor(p2))
                if (
                    0 <= x < cells.edge
                    and 0 <= y < cells.edge
                    and 0 <= z < cells.edge
                    and descend(cells, path, x, y, z) == EMPTY
                ):
                    width = cells.width[path[levels]]
                    free = min(_left(p0, d0, x, width), _left(p1, d1, y, width), _left(p2, d2, z, width))
                    if free >= 0:
                        k += int(free / STEP)
                        continue
                x, y, z = int(np.floor(p0 - 0.5)), int(np.floor(p1 - 0.5)), int(np.floor(p2 - 0.5))
                f0, f1, f2 = p0 - 0.5 - x, p1 - 0.5 - y, p2 - 0.5 - z
                sigma, r, g, b = 0.0, 0.0, 0.0, 0.0
                for corner in range(8):
                    c0, c1, c2 = corner >> 2, corner >> 1 & 1, corner & 1
                    v0, v1, v2 = x + c0, y + c1, z + c2
                    if not (0 <= v0 < cells.edge and 0 <= v1 < cells.edge and 0 <= v2 < cells.edge):
                        continue
                    slot = descend(cells, path, v0, v1, v2)
                    if slot == EMPTY:
                        continue
                    row = -2 - slot
                    weight = (f0 if c0 else 1 - f0) * (f1 if c1 else 1 - f1) * (f2 if c2 else 1 - f2)
                    weight *= values[row, 3 * B]
                    sigma += weight
                    dr, dg, db = sums(values, row, basis, ray)
                    r, g, b = r + weight * dr, g + weight * dg, b + weight * db
                if sigma <= 0:
                    continue
                depth = sigma * length / scale
                kept = np.exp(-depth)
                lost = through * (1 - kept)
                red += lost * sigmoid(r / sigma)
                green += lost * sigmoid(g / sigma)
                blue += lost * sigmoid(b / sigma)
                far += lost * (start + t) / scale
                through *= kept
                if through < cut:
                    break
            out[ray, 0], out[ray, 1], out[ray, 2], out[ray, 3], out[ray, 4] = red, green, blue, 1 - through, far


@compiled()
def _left(p: float, d: float, cell: int, width: float) -> Any:
    """How far a ray stays half a cell away from the sides of an empty cell, which then holds all eight neighbours; < 0:
    it is nearer.
    """
    low = np.floor((cell + 0.5) / width) * width + 0.5
    high = low + width - 1
    if p < low or p > high:
        return -1.0
    if d > 0:
        return (high - p) / d
    return (low - p) / d if d < 0 else np.inf
