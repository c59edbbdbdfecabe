"""A tree of cubes in one table, whatever it was made from: octree, N3Tree or VDB; and the way down to a point.

A node of level l has 2^bits[l] cells an edge; its cells stand in a row of the table, x-major:

    slots[first[l] + (node << 3 bits[l]) + (cx << 2 bits[l] | cy << bits[l] | cz)]
                                     >= 0  number of the child, a node of level l + 1
                                       -1  empty space
                                    <= -2  a leaf, whose values are row -2 - slot

Positions are in cells of the last level, from the root's lowest corner. Where cells come in twos, the bits of a whole
position are the way down; any other N has its digits spread into bits first, and cells that do not exist are empty.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.jit import compiled

EMPTY = -1


class Cells(NamedTuple):
    """shift[l]: bits of a position below level l's cells; width[l]: their edge; edge: the root's; radix: N, or 0."""

    slots: npt.NDArray[np.int32]
    first: Ints
    bits: Ints
    shift: Ints
    width: npt.NDArray[np.float64]
    edge: int
    radix: int


def cells_of(slots: npt.NDArray[np.int32], bits: list[int], *, first: list[int] | None = None, radix: int = 0) -> Cells:
    """first: where each level's nodes start in the table; without it, nodes are numbered through. radix: an N that is
    no power of two.
    """
    below = np.cumsum(np.array(bits[::-1], np.int64))[::-1] - np.array(bits)
    width = np.int64(radix or 2) ** (np.arange(len(bits))[::-1] if radix else below)
    edge = int(width[0]) * (radix or 1 << bits[0])
    starts = np.zeros(len(bits), np.int64) if first is None else np.array(first, np.int64)
    return Cells(slots.reshape(-1), starts, np.array(bits, np.int64), below, np.asarray(width, np.float64), edge, radix)


def rows_at(cells: Cells, points: npt.NDArray[np.float64]) -> Ints:
    """(m,) the row of the leaf around each point, -1 for empty space and outside; points (m, 3)."""
    found = np.full(len(points), EMPTY, np.int64)
    at = np.flatnonzero(((points >= 0) & (points < cells.edge)).all(axis=1))
    x, y, z = (_spread(cells, points[at, axis].astype(np.int64)) for axis in range(3))
    node = np.zeros(len(at), np.int64)
    for first, bits, shift in zip(cells.first, cells.bits, cells.shift, strict=True):
        low = (1 << bits) - 1
        cell = (x >> shift & low) << 2 * bits | (y >> shift & low) << bits | z >> shift & low
        slot = cells.slots[first + (node << 3 * bits) + cell].astype(np.int64)
        leaf, on = slot < EMPTY, slot >= 0
        found[at[leaf]] = -2 - slot[leaf]
        at, x, y, z, node = at[on], x[on], y[on], z[on], slot[on]
    return found


def _spread(cells: Cells, position: Ints) -> Ints:
    if not cells.radix:
        return position
    code, rest = np.zeros_like(position), position
    for shift in cells.shift[::-1]:
        code |= rest % cells.radix << shift
        rest = rest // cells.radix
    return code


# -- compiled --------------------------------------------------------------------------------------------------
@compiled()
def new_path(cells: Cells) -> Ints:
    """What `descend` remembers: a node for each level, the level, and the position it was at."""
    return np.zeros(len(cells.bits) + 4, np.int64)


@compiled(inline=True)  # else every call counts references to the arrays: 200 cycles
def descend(cells: Cells, path: Ints, x: int, y: int, z: int) -> Any:
    """The slot that holds this cell of the last level; path[levels] is then the level of that slot.

    It starts from the lowest node that also held the cell asked for before: for neighbours, that is one or two steps.
    """
    levels = len(cells.bits)
    if cells.radix:
        x, y, z = _encoded(cells, x), _encoded(cells, y), _encoded(cells, z)
    differ = (x ^ path[levels + 1]) | (y ^ path[levels + 2]) | (z ^ path[levels + 3])
    level = path[levels]
    while level > 0 and differ >> (cells.shift[level] + cells.bits[level]) != 0:
        level -= 1
    path[levels + 1], path[levels + 2], path[levels + 3] = x, y, z
    node = path[level]
    while True:
        bits, shift = cells.bits[level], cells.shift[level]
        low = (1 << bits) - 1
        cell = (x >> shift & low) << 2 * bits | (y >> shift & low) << bits | z >> shift & low
        slot = np.int64(cells.slots[cells.first[level] + (node << 3 * bits) + cell])
        if slot < 0:
            path[levels] = level
            return slot
        node = slot
        level += 1
        path[level] = node


@compiled()
def _encoded(cells: Any, position: int) -> int:
    code = 0
    for level in range(len(cells.bits) - 1, -1, -1):
        code |= position % cells.radix << cells.shift[level]
        position //= cells.radix
    return code
