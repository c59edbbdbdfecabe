"""The region-adaptive Haar transform over the leaves of an octree, and its inverse for blocks of neighbouring leaves.

Points (leaves, in Morton order) that differ only in the lowest bit of their Morton code form a pair; then those that
differ in the next bit, and so on up to the root: three binary levels for each level of the octree. A point without a
partner waits. A larger leaf has zeros in its lower bits and no neighbour in its cube, so it enters at its own level
without a special rule.

    sum        = p low + q high      p = sqrt(l / (l + h)), q = sqrt(h / (l + h))
    difference = p high - q low      l, h: number of leaves in the lower and the upper half

    low  = p sum - q difference      high = q sum + p difference

The sum goes on to the next level and the difference is a coefficient: the transform is orthonormal. Every term is
rounded to float64 in the order written here, and forward() rounds its output to the type of its points, so all CPUs
compute the same numbers.
Source: de Queiroz and Chou, "Compression of 3D point clouds using a region-adaptive hierarchical transform", 2016, with
the weight 1 for every leaf.

The values inside a cube of the octree depend only on the pairs in the cube, once its sum is known. So restore() first
inverts the few pairs above the cubes, and then each cube separately, in little memory, on any core, with the same bits
as inverse().
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled
from nerfbake.kernels.octree.pyramid import INNER, Level
from nerfbake.kernels.parallel import on_every_core

Ints = npt.NDArray[np.int64]
Counts = npt.NDArray[np.int32]
Floats = npt.NDArray[np.float64]
Points = npt.NDArray[np.floating]


class Merges(NamedTuple):
    """The m - 1 pairs of m points, from the coarsest binary level to the finest, in Morton order within a level.

    low, high              (m - 1,) int32 the first point of the lower and of the upper half
    low_count, high_count  (m - 1,) int32 number of points in each half
    ends                   (levels,) int64 where the pairs of each binary level end, the coarsest first
    """

    low: Counts
    high: Counts
    low_count: Counts
    high_count: Counts
    ends: Ints

    @property
    def rows(self) -> Counts:
        """(m,) the point in whose place each row of coefficients is stored: the mean first, then the pairs in order."""
        return np.concatenate([np.zeros(1, np.int32), self.high])


def levels_of(masks: npt.NDArray[np.uint8], levels: int) -> list[Level]:
    """Return the levels of the octree, with its leaves numbered breadth-first.

    masks: the child mask of every node above the last level, breadth-first; they must be valid.
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
    """(m,) rising Morton codes of the leaves' lowest voxels, and (m,) the number of each leaf.

    height: the depth of the level of single voxels.
    """
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
    """The pairs of points with these rising Morton codes, under a root of 2^height voxels along an edge."""
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


def forward(points: Points, merges: Merges, blocks: HaarBlocks) -> None:
    """Transform (m, C) values of points into coefficients, in place. blocks: blocks_of(merges).

    The difference of a pair replaces the first point of its upper half.
    """
    _forward_blocks(points, merges, blocks)
    _forward_coarse(points, merges, len(blocks.heads) - 2)


def inverse(rows: npt.NDArray[Any], steps: Floats, merges: Merges) -> Floats:
    """(m, C) the values of the points.

    rows: coefficients in the order of `merges.rows`, in multiples of the step of their channel.
    """
    points = np.empty(rows.shape)
    points[0] = rows[0] * steps
    _inverse(rows, steps, points, merges)
    return points


# -- compiled --------------------------------------------------------------------------------------------------
@compiled()
def _pair_up(codes: Ints, level: Ints, low: Counts, high_count: Counts) -> None:
    """Find the merges of rising codes. Every point but the first starts a half, which is merged with the half at `low`.

    level: the highest bit in which the point differs from the previous one, where the halves merge. high_count: the
    number of points in the half that the point starts.
    """
    m = len(codes)
    stack = np.zeros(m + 1, np.int64)  # start points of the halves that are still open, the first at the bottom
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


@on_every_core
@compiled()
def _forward_blocks(core: int, cores: int, points: Points, merges: Merges, blocks: HaarBlocks) -> None:
    for block in range(core, len(blocks.heads) - 1, cores):
        for i in range(blocks.first[block + 1] - 1, blocks.first[block] - 1, -1):
            _merge(points, merges, blocks.pairs[i])


@compiled()
def _forward_coarse(points: Points, merges: Merges, count: int) -> None:
    for pair in range(count - 1, -1, -1):
        _merge(points, merges, pair)


@compiled(merged=True)
def _merge(points: Points, merges: Merges, pair: int) -> None:
    """Replace the halves of a pair by their sum and their difference."""
    p, q = _weights(merges, pair)
    a, b = merges.low[pair], merges.high[pair]
    for c in range(points.shape[1]):
        below, above = points[a, c], points[b, c]
        points[a, c] = p * below + q * above
        points[b, c] = p * above - q * below


@compiled()
def _inverse(rows: npt.NDArray[Any], steps: Floats, points: Floats, merges: Merges) -> None:
    for pair in range(len(merges.low)):
        p, q = _weights(merges, pair)
        a, b = merges.low[pair], merges.high[pair]
        for c in range(points.shape[1]):
            total, difference = points[a, c], rows[pair + 1, c] * steps[c]
            points[a, c] = p * total - q * difference
            points[b, c] = q * total + p * difference


@compiled(merged=True)
def _weights(merges: Merges, pair: int) -> tuple[float, float]:
    """p and q of a pair."""
    low, high = merges.low_count[pair], merges.high_count[pair]
    return np.sqrt(low / (low + high)), np.sqrt(high / (low + high))


_BITS = 12  # binary levels of a block: up to 4096 leaves


class HaarBlocks(NamedTuple):
    """Blocks of points that are transformed and restored independently.

    heads (b + 1,): the first point of each block, then m. pairs (m - b,): the pairs in blocks, by block and from coarse
    to fine in each; first (b + 1,): where the pairs of each block begin.
    """

    heads: Ints
    pairs: Counts
    first: Ints


def blocks_of(merges: Merges) -> HaarBlocks:
    """The cubes that the last 12 binary levels divide."""
    levels, m = len(merges.ends), len(merges.low) + 1
    coarse = int(merges.ends[levels - _BITS - 1]) if levels > _BITS else 0
    heads = np.sort(np.append(merges.high[:coarse], 0)).astype(np.int64)
    block = np.searchsorted(heads, merges.low[coarse:], side="right") - 1
    pairs = coarse + np.argsort(block, kind="stable")
    first = np.append(0, np.cumsum(np.bincount(block, minlength=len(heads))))
    return HaarBlocks(np.append(heads, m), pairs.astype(np.int32), first)


def restore(
    rows: npt.NDArray[np.int32], steps: Floats, merges: Merges, mixing: Floats, leaf: Ints
) -> tuple[npt.NDArray[np.float32], Floats]:
    """(m, C) float32 coefficients by leaf number, with 0 in the last column, and (m,) the values of the last channel.

    rows, steps, merges: see inverse(). A coefficient is the sum, over the channels except the last and from the first
    on, of the channel times mixing (C - 1, C - 1), whose rows are the channels. leaf (m,): the leaf number of each
    point.
    """
    order = np.zeros(0, np.int32)
    return _restored(rows, order, np.ones(len(steps)), steps, merges, blocks_of(merges), mixing, leaf)


def restore_rounded(
    points: npt.NDArray[np.float32], steps: Floats, merges: Merges, blocks: HaarBlocks, mixing: Floats, leaf: Ints
) -> tuple[npt.NDArray[np.float32], Floats]:
    """Return what restore() returns for the coefficients of forward(), rounded to multiples of `steps`."""
    return _restored(points, merges.rows, steps, steps, merges, blocks, mixing, leaf)


def _restored(
    coefficients: npt.NDArray[Any],
    order: Counts,
    units: Floats,
    steps: Floats,
    merges: Merges,
    blocks: HaarBlocks,
    mixing: Floats,
    leaf: Ints,
) -> tuple[npt.NDArray[np.float32], Floats]:
    """order: the place of each row in `coefficients`; without it, they are rows. units: of `coefficients`."""
    b = len(blocks.heads) - 1
    low, high = (np.searchsorted(blocks.heads, each[: b - 1]).astype(np.int32) for each in (merges.low, merges.high))
    coarse = np.rint(coefficients[order[:b] if len(order) else slice(b)] / units)
    sums = inverse(coarse, steps, merges._replace(low=low, high=high))
    values, last = np.zeros(coefficients.shape, np.float32), np.empty(len(coefficients))
    _restore(coefficients, order, units, steps, merges, blocks, sums, mixing, leaf, values, last)
    return values, last


@on_every_core
@compiled()
def _restore(
    core: int,
    cores: int,
    coefficients: npt.NDArray[Any],
    order: Counts,
    units: Floats,
    steps: Floats,
    merges: Merges,
    blocks: HaarBlocks,
    sums: Floats,
    mixing: Floats,
    leaf: Ints,
    values: npt.NDArray[np.float32],
    last: Floats,
) -> None:
    C = len(steps)
    own = np.empty(C - 1)
    for block in range(core, len(sums), cores):
        begin = blocks.heads[block]
        points = np.empty((blocks.heads[block + 1] - begin, C))
        for c in range(C):
            points[0, c] = sums[block, c]
        for i in range(blocks.first[block], blocks.first[block + 1]):
            pair = blocks.pairs[i]
            p, q = _weights(merges, pair)
            a, b = merges.low[pair] - begin, merges.high[pair] - begin
            row = order[pair + 1] if len(order) else pair + 1
            for c in range(C):
                # 0.0 makes a 0 of -0, as of an integer.
                total, difference = points[a, c], (np.rint(coefficients[row, c] / units[c]) + 0.0) * steps[c]
                points[a, c] = p * total - q * difference
                points[b, c] = q * total + p * difference
        for point in range(len(points)):
            row = leaf[begin + point]
            own[:] = 0
            for s in range(C - 1):
                for c in range(C - 1):
                    own[c] += points[point, s] * mixing[s, c]
            for c in range(C - 1):
                values[row, c] = own[c]
            last[row] = points[point, C - 1]
