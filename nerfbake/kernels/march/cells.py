"""A tree of cells in one table, built from an octree, an N3Tree or a VDB, and the descent to a point.

A node of level l has 2^bits[l] cells along an edge. Its cells are contiguous in the table, x-major:

    slots[first[l] + (node << 3 bits[l]) + (cx << 2 bits[l] | cy << bits[l] | cz)]
                                     >= 0  number of the child, a node of level l + 1
                                       -1  empty space
                                    <= -2  a leaf, whose values are row -2 - slot

Positions are in cells of the last level, from the lowest corner of the root. If nodes have a power of two of cells
along an edge, the bits of an integer position are the path down. For any other N, the base-N digits of the position are
spread into bits first, and cells that do not exist are empty.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.jit import compiled

EMPTY = -1
_TOP_SHARE = 16  # the grid of the first levels has at most one cell for so many slots
_LEVEL_BITS = 6


class Cells(NamedTuple):
    """The table of a tree, and a grid of its first levels.

    shift[l]: bits of a position below the cells of level l; width[l]: their edge; edge: that of the root; radix: N, or
    0.

    top: the result of the descent through the first levels, for 2^top_bits cells along an edge, x-major; a position has
    top_below bits below these cells. An entry is a slot and, in its last bits, the level at which it was found.
    """

    slots: npt.NDArray[np.int32]
    first: Ints
    bits: Ints
    shift: Ints
    width: npt.NDArray[np.float64]
    edge: int
    radix: int
    top: Ints
    top_bits: int
    top_below: int


def cells_of(slots: npt.NDArray[np.int32], bits: list[int], *, first: list[int] | None = None, radix: int = 0) -> Cells:
    """Build the tree.

    first: where the nodes of each level start in the table; without it, nodes are numbered across all levels. radix: an
    N that is not a power of two.
    """
    below = np.cumsum(np.array(bits[::-1], np.int64))[::-1] - np.array(bits)
    width = np.int64(radix or 2) ** (np.arange(len(bits))[::-1] if radix else below)
    edge = int(width[0]) * (radix or 1 << bits[0])
    starts = np.zeros(len(bits), np.int64) if first is None else np.array(first, np.int64)
    widths, table = np.asarray(width, np.float64), slots.reshape(-1)
    sizes = [1 << min(3 * bit, 62) for bit in np.cumsum(bits).tolist()]
    levels = max(1, sum(_TOP_SHARE * size <= table.size for size in sizes))
    top = _top(table, starts, bits[:levels])
    own = top, sum(bits[:levels]), int(below[levels - 1])
    return Cells(table, starts, np.array(bits, np.int64), below, widths, edge, radix, *own)


def with_rows(cells: Cells, slot: npt.NDArray[np.int32]) -> Cells:
    """Return the same tree with slot[i] in place of the leaf with row i: EMPTY, or the slot of another row."""
    slots = cells.slots.copy()
    leaves = np.flatnonzero(slots < EMPTY)
    slots[leaves] = slot[-2 - slots[leaves]]
    return cells_of(slots, cells.bits.tolist(), first=cells.first.tolist(), radix=cells.radix)


def _top(slots: npt.NDArray[np.int32], first: Ints, bits: list[int]) -> Ints:
    """The slot and the level of each cell after these levels, x-major."""
    found = np.zeros((1, 1, 1), np.int64)  # only node 0
    for level, (start, width) in enumerate(zip(first, bits, strict=False)):
        for axis in range(3):
            found = found.repeat(1 << width, axis)
        low = np.arange(len(found)) & (1 << width) - 1
        cell = low[:, None, None] << 2 * width | low[:, None] << width | low
        node = found >> _LEVEL_BITS
        inside = slots[start + (np.maximum(node, 0) << 3 * width) + cell].astype(np.int64)
        found = np.where(node >= 0, inside << _LEVEL_BITS | level, found)
    return found.reshape(-1)


def rows_at(cells: Cells, points: npt.NDArray[np.float64]) -> Ints:
    """(m,) the row of the leaf that contains each point (m, 3); -1 in empty space and outside."""
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
@compiled(inline=True)  # otherwise every call counts references to the arrays: 200 cycles
def descend(cells: Cells, cell: tuple[int, int, int]) -> Any:
    """Return the slot that contains this cell of the last level, and the level of that slot."""
    x, y, z = cell
    if cells.radix:
        x, y, z = _encoded(cells, x), _encoded(cells, y), _encoded(cells, z)
    below, bits = cells.top_below, cells.top_bits
    both = cells.top[(x >> below) << 2 * bits | (y >> below) << bits | z >> below]
    slot, level = both >> _LEVEL_BITS, both & (1 << _LEVEL_BITS) - 1
    while slot >= 0:
        level += 1
        bits, shift = cells.bits[level], cells.shift[level]
        low = (1 << bits) - 1
        part = (x >> shift & low) << 2 * bits | (y >> shift & low) << bits | z >> shift & low
        slot = np.int64(cells.slots[cells.first[level] + (slot << 3 * bits) + part])
    return slot, level


@compiled(inline=True)
def lowest(cells: Cells, level: int, cell: tuple[int, int, int]) -> tuple[float, float, float]:
    """Return the lowest corner of the cell of this level that contains a cell of the last level."""
    x, y, z = cell
    if cells.radix:
        width = np.int64(cells.width[level])
        return float(x - x % width), float(y - y % width), float(z - z % width)
    shift = cells.shift[level]
    return float(x >> shift << shift), float(y >> shift << shift), float(z >> shift << shift)


@compiled()
def _encoded(cells: Any, position: int) -> int:
    code = 0
    for level in range(len(cells.bits) - 1, -1, -1):
        code |= position % cells.radix << cells.shift[level]
        position //= cells.radix
    return code
