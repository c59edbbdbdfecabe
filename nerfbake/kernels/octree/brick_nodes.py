"""Bricks of 8^3 cells as nodes of an octree that divides them three times: which nodes exist, and what they contain.

    brick    8^3 cells    8 blocks of 4^3, each of which is a node if it is not empty
    block    4^3 cells    8 blocks of 2^3, each of which is a leaf (a wide cell), a node, or empty
    block    2^3 cells    8 cells, each of which is a leaf or empty

A path down is three octants, each with one bit for x, y and z. In a table of cells (x << 6 | y << 3 | z) the first
octant sets the bits of value 4, the second those of value 2, the third those of value 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Ints


def _paths(octants: int) -> Ints:
    """(8^octants,) the place of each path's cell in an x-major table of 2^octants cells along an edge."""
    steps = np.array([x << 2 * octants | y << octants | z for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    places = np.zeros(1, np.int64)
    for _ in range(octants):
        places = (2 * places[:, None] + steps).reshape(-1)
    return places


PATHS, BLOCK_PATHS = _paths(3), _paths(2)  # cells of a brick; blocks of 2^3 of a brick


class BrickNodes(NamedTuple):
    """The contents of q bricks, by octants 4x + 2y + z.

    row (q, 8, 8, 8) int32: the row of each cell, arbitrary if the cell is empty; held (q, 8, 8, 8): the cells that are
    not empty; wide (q, 8, 8): the blocks of 2^3 that are one cell; split (q, 8, 8): the blocks of 2^3 with single
    cells.
    """

    row: npt.NDArray[np.int32]
    held: Bits
    wide: Bits
    split: Bits

    @property
    def blocks(self) -> Bits:
        """(q, 8) the blocks of 4^3 that are not empty."""
        some: Bits = np.any(self.wide | self.split, axis=2)
        return some


def brick_nodes(rows: npt.NDArray[np.int32], filled: Bits) -> BrickNodes:
    """Build the nodes of bricks with cells `rows` (q, 512), -1 or row << 1 | wide; filled (n,): the rows to include."""
    number = rows[:, PATHS].reshape(-1, 8, 8, 8)
    held = number >= 0
    row = number >> 1
    held[held] = filled[row[held]]
    wide = held[..., 0] & (number[..., 0] & 1 == 1)
    return BrickNodes(row, held, wide, np.any(held, axis=3) & ~wide)


def numbered(there: Bits, first: Ints) -> Ints:
    """Number the set entries of each row i consecutively, from first[i] on.

    there (q, ...), first (q,) -> (q, ...), valid where `there` is set.
    """
    flat = there.reshape(len(there), -1)
    return (np.cumsum(flat, axis=1) - 1 + first[:, None]).reshape(there.shape)
