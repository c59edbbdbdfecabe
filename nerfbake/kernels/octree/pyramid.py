"""The levels of an octree while it is made: parents above, children below, everything breadth-first."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints

INNER = -1  # in place of a leaf's number: the node has children
_CHUNK = 1 << 16  # nodes at a time: temporaries stay in the cache, and memory bounded


class Level(NamedTuple):
    """One level's nodes in breadth-first order: by parent, then by octant."""

    parent: npt.NDArray[np.int32]  # index in the level above
    octant: npt.NDArray[np.uint8]
    leaf: npt.NDArray[np.int32]  # which leaf it is, a number of the caller's, or INNER

    def take(self, which: npt.NDArray[np.bool_]) -> Level:
        return Level(self.parent[which], self.octant[which], self.leaf[which])


def child_counts(levels: list[Level], height: int) -> Ints:
    """(m,) children of each node of a level."""
    nodes = len(levels[height].leaf)
    if height + 1 == len(levels):
        return np.zeros(nodes, np.int64)
    return np.bincount(levels[height + 1].parent, minlength=nodes)


def drop_empty(levels: list[Level], holds: Callable[[npt.NDArray[np.int32]], npt.NDArray[np.bool_]]) -> list[Level]:
    """Without leaves that hold nothing, and inner nodes that have no leaf below them, from the last level up.

    holds((m,) leaves) -> (m,) bool. The root stays; where it holds nothing, it is an inner node without children.
    """
    kept = list(levels)
    for height in range(len(kept) - 1, -1, -1):
        level = kept[height]
        barren = child_counts(kept, height) == 0
        leaves = np.flatnonzero(level.leaf != INNER)
        barren[leaves] = ~holds(level.leaf[leaves])
        if height == 0:
            kept[0] = level._replace(leaf=np.where(barren, np.int32(INNER), level.leaf))
        elif barren.any():
            _take(kept, height, ~barren)
    return _without_empty_levels(kept)


def merge_equal(levels: list[Level], same: Callable[[npt.NDArray[np.int32]], npt.NDArray[np.bool_]]) -> list[Level]:
    """Eight leaves that are all the same become one, from the last level up.

    same((m, 8) leaves) -> (m,) bool.
    """
    kept = list(levels)
    for height in range(len(kept) - 1, 0, -1):
        level, above = kept[height], kept[height - 1]
        leaves = np.bincount(level.parent[level.leaf != INNER], minlength=len(above.leaf))
        whole = leaves == 8
        if not whole.any():
            continue
        groups = level.leaf[whole[level.parent]].reshape(-1, 8)
        equal = same(groups)
        merged = np.flatnonzero(whole)[equal]
        if not len(merged):
            continue
        leaf = above.leaf.copy()
        leaf[merged] = groups[equal, 0]
        kept[height - 1] = above._replace(leaf=leaf)
        gone = np.zeros(len(above.leaf), bool)
        gone[merged] = True
        _take(kept, height, ~gone[level.parent])
    return _without_empty_levels(kept)


def children_table(levels: list[Level], *, all_slots: bool) -> npt.NDArray[np.int32]:
    """(c, 8) int32 rows of the children, 0 = none; c counts all nodes, or only those above the last level."""
    nodes = sum(len(level.leaf) for level in levels)
    # Zeroed pages that nobody writes to cost no memory: the last level's slots are free.
    table = np.zeros((nodes if all_slots else nodes - len(levels[-1].leaf), 8), np.int32)
    start = 0
    for above, level in pairwise(levels):
        first = start + len(above.leaf)
        for begin in range(0, len(level.leaf), _CHUNK):
            parent, octant = level.parent[begin : begin + _CHUNK], level.octant[begin : begin + _CHUNK]
            row = first + begin
            table[start + parent, octant] = np.arange(row, row + len(parent), dtype=np.int32)
        start = first
    return table


def _take(levels: list[Level], height: int, keep: npt.NDArray[np.bool_]) -> None:
    """Keeps some nodes of a level; those that go must have no children."""
    levels[height] = levels[height].take(keep)
    if height + 1 < len(levels):
        rank = np.cumsum(keep, dtype=np.int32) - 1
        below = levels[height + 1]
        levels[height + 1] = below._replace(parent=rank[below.parent])


def _without_empty_levels(levels: list[Level]) -> list[Level]:
    return [level for height, level in enumerate(levels) if height == 0 or len(level.leaf)]
