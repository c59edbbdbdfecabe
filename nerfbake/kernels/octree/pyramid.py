"""The levels of an octree under construction (parents above, children below, breadth-first), and means over nodes.

The means preserve the rendered picture: densities are weighted by volume, coefficients by volume and opacity.

The opacity of a piece is 1 - exp(-sigma l) with ONE length l for the whole scene, the width of the tree's finest cell.
So the mean does not depend on how finely a uniform region is divided, and the mean of means is the mean of everything
below: a level of detail looks the same as a bake at that resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from math import cbrt
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.maths.elementary import expm1
from nerfbake.kernels.parallel import over_chunks

_ROWS_AT_ONCE = 1 << 12  # rows at a time: temporaries stay in the second-level cache


def opacity(sigma: npt.NDArray[Any], length: float) -> Floats:
    """1 - exp(-sigma length), 0 for densities below 0."""
    flat = np.asarray(sigma).reshape(-1)
    found = np.empty(len(flat))

    def work(begin: int, end: int) -> None:
        depth = np.maximum(flat[begin:end], 0, dtype=np.float64) * length
        found[begin:end] = -expm1(-depth)

    over_chunks(work, len(flat), 1 << 14)
    return found.reshape(np.shape(sigma))


def mean_edge(edges: Floats) -> float:
    """The edge of the cube with the same volume as this box: (3,) -> their geometric mean."""
    return cbrt(float(np.prod(edges)))


def mean_of_runs(
    rows_at: Callable[[int, int], npt.NDArray[Any]],
    weight: Floats,
    volume: Floats,
    counts: npt.NDArray[np.int64],
    out: npt.NDArray[Any],
) -> Floats:
    """Compute means over runs of consecutive rows: the first run is counts[0] rows, the next counts[1], and so on.

    Writes the means to out (p, D), and returns the mean opacity of each run, which is its weight in the next mean.
    rows_at(begin, end): the values (end - begin, D) of some of the rows 0 .. m, density last; weight (m,): opacities;
    volume (m,): each row's share of the volume of its run (the rest up to 1 is empty). Sums run from the first row of a
    run to its last, the same on every machine.
    """
    ends = np.cumsum(counts)
    out_opacity = np.zeros(len(counts))
    # Blocks of whole runs with about the same number of rows.
    edges = np.flatnonzero(np.diff(ends // _ROWS_AT_ONCE, prepend=-1, append=-1))

    def work(begin: int, end: int) -> None:
        for run, stop in zip(edges[begin:end], edges[begin + 1 : end + 1], strict=True):
            some = slice(run, stop)
            first, last = int(ends[run] - counts[run]), int(ends[stop - 1])
            share = weight[first:last] * volume[first:last]
            rows = rows_at(first, last).astype(np.float32, copy=False)
            pieces = rows * share.astype(np.float32)[:, None]
            pieces[:, -1] = rows[:, -1] * volume[first:last]
            total, out_opacity[some] = _sums(pieces, share, counts[some])
            divisor = out_opacity[some].astype(np.float32)
            total[:, :-1] /= np.where(divisor > 0, divisor, 1)[:, None]
            out[some] = total

    over_chunks(work, len(edges) - 1, 1)
    return out_opacity


def _sums(
    pieces: npt.NDArray[np.float32], share: Floats, counts: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float32], Floats]:
    """The sums of each run, row after row."""
    # Longest runs first, so that the runs with a k-th row come first.
    order = np.argsort(-counts, kind="stable")
    starts = (np.cumsum(counts) - counts)[order]
    with_at_least = np.searchsorted(-counts[order], -np.arange(int(counts.max())), side="left")
    total, opacities = np.zeros((len(counts), pieces.shape[1]), np.float32), np.zeros(len(counts))
    for k, some in enumerate(with_at_least):
        rows = starts[:some] + k
        total[:some] += pieces.take(rows, axis=0)
        opacities[:some] += share[rows]
    back = np.empty(len(order), np.int64)
    back[order] = np.arange(len(order))
    return total.take(back, axis=0), opacities[back]


INNER = -1  # in place of a leaf number: the node has children
_NODES_AT_ONCE = 1 << 16  # nodes at a time: temporaries stay in the cache, and memory stays bounded


class Level(NamedTuple):
    """One level's nodes in breadth-first order: by parent, then by octant."""

    parent: npt.NDArray[np.int32]  # index in the level above
    octant: npt.NDArray[np.uint8]
    leaf: npt.NDArray[np.int32]  # leaf number, assigned by the caller, or INNER

    def take(self, which: npt.NDArray[np.bool_]) -> Level:
        return Level(self.parent[which], self.octant[which], self.leaf[which])


def child_counts(levels: list[Level], height: int) -> Ints:
    """(m,) number of children of each node of a level."""
    nodes = len(levels[height].leaf)
    if height + 1 == len(levels):
        return np.zeros(nodes, np.int64)
    return np.bincount(levels[height + 1].parent, minlength=nodes)


def drop_empty(levels: list[Level], holds: Callable[[npt.NDArray[np.int32]], npt.NDArray[np.bool_]]) -> list[Level]:
    """Remove empty leaves, and inner nodes without leaves below them, from the last level up.

    holds((m,) leaves) -> (m,) bool: whether each leaf is not empty. The root stays; if it is empty, it becomes an inner
    node without children.
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
    """Merge eight equal leaves into one, from the last level up.

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
    """(c, 8) int32 rows of the children, 0 = none; c is the number of all nodes, or of those above the last level."""
    nodes = sum(len(level.leaf) for level in levels)
    # Zeroed pages that are never written take no memory: the slots of the last level are free.
    table = np.zeros((nodes if all_slots else nodes - len(levels[-1].leaf), 8), np.int32)
    start = 0
    for above, level in pairwise(levels):
        first = start + len(above.leaf)
        for begin in range(0, len(level.leaf), _NODES_AT_ONCE):
            parent, octant = level.parent[begin : begin + _NODES_AT_ONCE], level.octant[begin : begin + _NODES_AT_ONCE]
            row = first + begin
            table[start + parent, octant] = np.arange(row, row + len(parent), dtype=np.int32)
        start = first
    return table


def _take(levels: list[Level], height: int, keep: npt.NDArray[np.bool_]) -> None:
    """Keep the selected nodes of a level. The removed ones must have no children."""
    levels[height] = levels[height].take(keep)
    if height + 1 < len(levels):
        rank = np.cumsum(keep, dtype=np.int32) - 1
        below = levels[height + 1]
        levels[height + 1] = below._replace(parent=rank[below.parent])


def _without_empty_levels(levels: list[Level]) -> list[Level]:
    return [level for height, level in enumerate(levels) if height == 0 or len(level.leaf)]
