"""Bricks of 8^3 cells as the nodes of a tree that halves them three times: which nodes there are, and what they hold.

    brick    8^3 cells    8 blocks of 4^3, of which each is a node where it holds anything
    block    4^3 cells    8 blocks of 2^3, of which each is a leaf (a wide cell), a node, or empty
    block    2^3 cells    8 cells, of which each is a leaf or empty

A path down is three octants, each of which says x, y, z with a bit; in a table of cells (x << 6 | y << 3 | z) the first
octant sets the bits of 4, the second those of 2, the third those of 1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Ints


def _paths(octants: int) -> Ints:
    """(8^octants,) the place of each path's cell in an x-major table that is 2^octants cells wide."""
    steps = np.array([x << 2 * octants | y << octants | z for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    places = np.zeros(1, np.int64)
    for _ in range(octants):
        places = (2 * places[:, None] + steps).reshape(-1)
    return places


PATHS, BLOCK_PATHS = _paths(3), _paths(2)  # of cells in a brick, of blocks of 2^3 in a brick


class BrickNodes(NamedTuple):
    """What is in q bricks, by octants 4x + 2y + z.

    row (q, 8, 8, 8) int32 the row of each cell, whatever it is where it is empty; held (q, 8, 8, 8) the cells that hold
    something; wide (q, 8, 8) the blocks of 2^3 that are one cell; split (q, 8, 8) those that have cells of their own.
    """

    row: npt.NDArray[np.int32]
    held: Bits
    wide: Bits
    split: Bits

    @property
    def blocks(self) -> Bits:
        """(q, 8) the blocks of 4^3 that hold something."""
        some: Bits = np.any(self.wide | self.split, axis=2)
        return some


def brick_nodes(rows: npt.NDArray[np.int32], filled: Bits) -> BrickNodes:
    """Of bricks with cells `rows` (q, 512), -1 or row << 1 | wide; filled (n,) the rows that count."""
    number = rows[:, PATHS].reshape(-1, 8, 8, 8)
    held = number >= 0
    row = number >> 1
    held[held] = filled[row[held]]
    wide = held[..., 0] & (number[..., 0] & 1 == 1)
    return BrickNodes(row, held, wide, np.any(held, axis=3) & ~wide)


def numbered(there: Bits, first: Ints) -> Ints:
    """Numbers from first[i] on for what is there in row i: there (q, ...), first (q,) -> (q, ...) where it is there."""
    flat = there.reshape(len(there), -1)
    return (np.cumsum(flat, axis=1) - 1 + first[:, None]).reshape(there.shape)
