"""The region-adaptive Haar transform over the leaves of an octree: pairs merge, a bit of the Morton code at a time.

Points (leaves, in Morton order) that differ in the lowest bit alone are a pair; then those in the next bit, and so on
up to the root, three binary levels for each level of the octree. What has no partner waits. A larger leaf has zeros for
its lower bits and no neighbour in its cube, so that it enters at its own level without any rule of its own.

    sum        = p low + q high      p = sqrt(l / (l + h)), q = sqrt(h / (l + h))
    difference = p high - q low      l, h: how many leaves are in the lower and the upper half

    low  = p sum - q difference      high = q sum + p difference

The sum goes on to the next level and the difference is a coefficient: the transform is orthonormal. Every term is
rounded to float64 in the order that is written here, and forward() rounds what it writes to the type of its points, so
that all CPUs make the same numbers.
Source: de Queiroz and Chou, "Compression of 3D point clouds using a region-adaptive hierarchical transform", 2016,
with the weight 1 for every leaf.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled
from nerfbake.kernels.octree.pyramid import INNER, Level

Ints = npt.NDArray[np.int64]
Counts = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]
Points = npt.NDArray[np.floating]


class Merges(NamedTuple):
    """The m - 1 pairs of m points, from the coarsest binary level to the finest, in Morton order within a level.

    low, high              (m - 1,) int32 the first point of the lower and of the upper half
    low_count, high_count  (m - 1,) int32 how many points each half has
    ends                   (levels,) int64 where the pairs of each binary level end, the coarsest first
    """

    low: Counts
    high: Counts
    low_count: Counts
    high_count: Counts
    ends: Ints

    @property
    def rows(self) -> Counts:
        """(m,) the point in whose place each row of coefficients comes out: the mean first, then the pairs in order."""
        return np.concatenate([np.zeros(1, np.int32), self.high])


def levels_of(masks: npt.NDArray[np.uint8], levels: int) -> list[Level]:
    """The octree's levels, its leaves numbered breadth-first.

    masks: of every node above the last level the children that it has, breadth-first; they must be sound.
    """
    found, first, leaves = [Level(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.zeros(1, np.int32))], 0, 0
    for depth in range(levels + 1):
        level = found[-1]
        own = masks[first : first + len(level.leaf)] if depth < levels else np.zeros(len(level.leaf), np.uint8)
        ends = own == 0
        level.leaf[:] = np.where(ends, leaves + np.cumsum(ends) - 1, INNER)
        first, leaves = first + len(own), leaves + int(ends.sum())
        parent, octant = np.nonzero(np.unpackbits(own[:, None], axis=1, bitorder="little"))
        if not len(parent):
            break
        found.append(Level(parent.astype(np.int32), octant.astype(np.uint8), np.empty(len(parent), np.int32)))
    return found


def leaf_codes(levels: list[Level], height: int) -> tuple[Ints, Ints]:
    """(m,) rising Morton codes of the leaves' lowest voxels, and (m,) the number of each; height: the last level's."""
    nodes, codes, leaves = np.zeros(1, np.int64), [], []
    for depth, level in enumerate(levels):
        if depth:
            nodes = nodes[level.parent] << 3 | level.octant
        ends = level.leaf != INNER
        codes.append(nodes[ends] << 3 * (height - depth))
        leaves.append(level.leaf[ends].astype(np.int64))
    all_codes = np.concatenate(codes)
    order = np.argsort(all_codes, kind="stable")
    return all_codes[order], np.concatenate(leaves)[order]


def merges_of(codes: Ints, height: int) -> Merges:
    """The pairs of points with these rising Morton codes, under a root 2^height voxels wide."""
    m, bits = len(codes), 3 * height
    level, low = np.zeros(m, np.int64), np.zeros(m, np.int32)
    high_count = np.zeros(m, np.int32)
    _pair_up(codes, level, low, high_count)
    # A stable sort keeps the Morton order within a level.
    high = 1 + np.argsort(-level[1:], kind="stable")
    counts = np.bincount(bits - 1 - level[1:], minlength=bits)
    return Merges(
        low[high], high.astype(np.int32), (high - low[high]).astype(np.int32), high_count[high], counts.cumsum()
    )


def forward(points: Points, merges: Merges) -> None:
    """(m, C) values of points become coefficients, in place: each pair's difference stands where its upper half did."""
    _forward(points, merges.low, merges.high, merges.low_count, merges.high_count)


def inverse(rows: npt.NDArray[Any], steps: Floats, merges: Merges) -> Floats:
    """(m, C) the values of points; rows: coefficients in the order of `merges.rows`, in steps of their channel."""
    points = np.empty(rows.shape)
    points[0] = rows[0] * steps
    _inverse(rows, steps, points, merges.low, merges.high, merges.low_count, merges.high_count)
    return points


# -- compiled --------------------------------------------------------------------------------------------------
@compiled()
def _pair_up(codes: Ints, level: Ints, low: Counts, high_count: Counts) -> None:
    """Of every point but the first: the highest bit in which it differs from the one before. There the half that it
    begins meets the half that `low` begins; high_count is how many points are in its own.
    """
    m = len(codes)
    stack = np.zeros(m + 1, np.int64)  # the points whose halves are still open, the first at the bottom
    depth = 1
    for i in range(1, m):
        differ, bit = codes[i] ^ codes[i - 1], -1
        while differ != 0:
            differ >>= 1
            bit += 1
        level[i] = bit
        while depth > 1 and level[stack[depth - 1]] < bit:
            depth -= 1
            high_count[stack[depth]] = i - stack[depth]
        low[i] = stack[depth - 1]
        stack[depth] = i
        depth += 1
    while depth > 1:
        depth -= 1
        high_count[stack[depth]] = m - stack[depth]


@compiled()
def _forward(points: Points, low: Counts, high: Counts, low_count: Counts, high_count: Counts) -> None:
    for pair in range(len(low) - 1, -1, -1):
        p = np.sqrt(low_count[pair] / (low_count[pair] + high_count[pair]))
        q = np.sqrt(high_count[pair] / (low_count[pair] + high_count[pair]))
        a, b = low[pair], high[pair]
        for c in range(points.shape[1]):
            below, above = points[a, c], points[b, c]
            points[a, c] = p * below + q * above
            points[b, c] = p * above - q * below


@compiled()
def _inverse(
    rows: npt.NDArray[Any],
    steps: Floats,
    points: Floats,
    low: Counts,
    high: Counts,
    low_count: Counts,
    high_count: Counts,
) -> None:
    for pair in range(len(low)):
        p = np.sqrt(low_count[pair] / (low_count[pair] + high_count[pair]))
        q = np.sqrt(high_count[pair] / (low_count[pair] + high_count[pair]))
        a, b = low[pair], high[pair]
        for c in range(points.shape[1]):
            total, difference = points[a, c], rows[pair + 1, c] * steps[c]
            points[a, c] = p * total - q * difference
            points[b, c] = q * total + p * difference
