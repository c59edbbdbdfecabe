"""Which cells a mask's nodes touch, and which nodes of a lattice matter to such cells."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Bits, Floats


def touched_cells(nodes: Bits) -> Bits:
    """(X + 1, Y + 1, Z + 1) the cells between nodes (X, Y, Z), and one around them, that have one at a corner."""
    cells = np.pad(nodes, 1)
    for axis in range(3):
        ends = np.arange(nodes.shape[axis] + 1)
        cells = cells.take(ends, axis) | cells.take(ends + 1, axis)
    return cells


def nodes_around(cells: Bits, box: Floats, own: Floats, shape: tuple[int, int, int], *, at_corners: bool) -> Bits:
    """(X, Y, Z) the nodes of a lattice of this shape and box (2, 3) that values within the cells are made of.

    cells (A, B, C) divide a box of their own. A node matters to what is nearer than a node's distance on every axis;
    one that only touches a cell is taken, too.
    """
    near = cells
    for axis, edge in enumerate(shape):
        count = cells.shape[axis]
        first = box[0, axis] if at_corners else box[0, axis] + (box[1, axis] - box[0, axis]) / edge / 2
        apart = (box[1, axis] - box[0, axis]) / (edge - at_corners)
        ends = first + apart * (np.arange(edge)[:, None] + (-1, 1))
        at = (ends - own[0, axis]) / (own[1, axis] - own[0, axis]) * count
        low, high = np.clip(np.floor(at[:, 0]), 0, count), np.clip(np.ceil(at[:, 1]), 0, count)
        before = np.zeros((*near.shape[:axis], 1, *near.shape[axis + 1 :]), np.int16)
        sums = np.concatenate([before, near.cumsum(axis, np.int16)], axis)
        near = sums.take(high.astype(np.int64), axis) > sums.take(low.astype(np.int64), axis)
    return near
