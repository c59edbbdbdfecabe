"""Median depths: where a ray has lost half of its light. Rays of a pinhole are made inside the kernel."""

from __future__ import annotations

from math import log
from typing import Any

import numpy as np

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.march.cells import EMPTY, Cells, descend, lowest
from nerfbake.kernels.march.lines import cell_at, cells_at_corners, exits, is_within, line_of, next_cell, part_in_box
from nerfbake.kernels.parallel import on_every_core

HALF = log(2)  # the optical depth at which half of the light is left
_OPAQUE = 7.0  # the optical depth at which a ray ends: 1/1000 of its light is left
_ROWS = 4  # rows of a picture that a core processes before it takes the next ones


@on_every_core
@compiled()
def march_medians(
    core: int,
    cores: int,
    cells: Cells,
    densities: Singles,
    box: Floats,
    place: Floats,
    pose: Floats,
    optics: Floats,
    depth: Singles,
    alpha: Singles,
) -> None:
    """Fill depth (H, W) with the distance, in world units, at which the optical depth is ln 2; inf if it never is.

    Fills alpha (H, W), too. densities (leaves,) per world unit; box (2, 3) in cells; place (3, 4): cells of the world;
    pose (3, 4): camera to world, OpenGL axes; optics: fx, fy, cx, cy of a pinhole, in pixels.
    """
    cells, densities, box, place, pose, optics, depth, alpha = borrowed(
        (cells, densities, box, place, pose, optics, depth, alpha)
    )
    H, W = depth.shape
    blocks = (H + _ROWS - 1) // _ROWS
    for block in range(core, blocks, cores):
        for y in range(block * _ROWS, min((block + 1) * _ROWS, H)):
            for x in range(W):
                depth[y, x], alpha[y, x] = _march(cells, densities, box, place, pose, optics, x, y)


@compiled()
def _march(
    cells: Cells, densities: Singles, box: Floats, place: Floats, pose: Floats, optics: Floats, column: int, row: int
) -> Any:
    """The median depth and the alpha of one pixel."""
    across, up = (column + 0.5 - optics[2]) / optics[0], -(row + 0.5 - optics[3]) / optics[1]
    norm = np.sqrt(across * across + up * up + 1)
    w0 = (pose[0, 0] * across + pose[0, 1] * up - pose[0, 2]) / norm
    w1 = (pose[1, 0] * across + pose[1, 1] * up - pose[1, 2]) / norm
    w2 = (pose[2, 0] * across + pose[2, 1] * up - pose[2, 2]) / norm
    d0 = place[0, 0] * w0 + place[0, 1] * w1 + place[0, 2] * w2
    d1 = place[1, 0] * w0 + place[1, 1] * w1 + place[1, 2] * w2
    d2 = place[2, 0] * w0 + place[2, 1] * w1 + place[2, 2] * w2
    scale = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    d0, d1, d2, world = d0 / scale, d1 / scale, d2 / scale, 1 / scale
    e0 = place[0, 0] * pose[0, 3] + place[0, 1] * pose[1, 3] + place[0, 2] * pose[2, 3] + place[0, 3]
    e1 = place[1, 0] * pose[0, 3] + place[1, 1] * pose[1, 3] + place[1, 2] * pose[2, 3] + place[1, 3]
    e2 = place[2, 0] * pose[0, 3] + place[2, 1] * pose[1, 3] + place[2, 2] * pose[2, 3] + place[2, 3]
    low, high = (box[0, 0], box[0, 1], box[0, 2]), (box[1, 0], box[1, 1], box[1, 2])
    start, end = part_in_box(low, high, (e0, e1, e2), (d0, d1, d2), np.inf)
    median = np.inf
    if start >= end:
        return np.float32(median), np.float32(0)
    line = line_of((e0 + start * d0, e1 + start * d1, e2 + start * d2), (d0, d1, d2))
    t, end, lost = 0.0, end - start, 0.0
    first, last = cells_at_corners(box)
    cell = cell_at(line, t, first, last)
    while t < end:
        slot, level = descend(cells, cell)
        low, width = lowest(cells, level, cell), cells.width[level]
        crossings = exits(low, width, line)
        ahead = max(min(crossings), t)
        if slot != EMPTY:
            sigma = np.float64(densities[-2 - slot])
            own = sigma * (min(ahead, end) - t) * world
            if lost + own >= HALF and lost < HALF:
                median = (start + t) * world + (HALF - lost) / sigma
            lost += own
            if lost > _OPAQUE:
                break
        t = ahead
        cell, axis = next_cell(low, width, crossings, line, t)
        if not is_within(cell, axis, first, last):
            break
    whole, rest = compiled_exp_parts(-lost)
    return np.float32(median), np.float32(1 - (whole + whole * rest))
