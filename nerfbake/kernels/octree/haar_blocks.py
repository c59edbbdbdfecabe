"""The Haar transform backwards, and what its channels stand for, a block of neighbouring leaves after the other.

Whatever a cube of the octree holds comes from its own pairs alone, once its sum is known. So the few pairs above the
cubes are undone first; then each cube is restored on its own, in little memory, on any core, to the same bits as
kernels.octree.haar.inverse() makes.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled
from nerfbake.kernels.octree.haar import Counts, Floats, Ints, Merges, inverse
from nerfbake.kernels.parallel import on_every_core

_BITS = 12  # binary levels of a block: up to 4096 leaves


class Blocks(NamedTuple):
    """heads (b + 1,) the first point of each block, and m. pairs (m - b,) the pairs in blocks, by block and from coarse
    to fine in each; first (b + 1,) where those of each block begin.
    """

    heads: Ints
    pairs: Counts
    first: Ints


def blocks_of(merges: Merges) -> Blocks:
    """The cubes that the last 12 binary levels are in."""
    levels, m = len(merges.ends), len(merges.low) + 1
    coarse = int(merges.ends[levels - _BITS - 1]) if levels > _BITS else 0
    heads = np.sort(np.append(merges.high[:coarse], 0)).astype(np.int64)
    block = np.searchsorted(heads, merges.low[coarse:], side="right") - 1
    pairs = coarse + np.argsort(block, kind="stable")
    first = np.append(0, np.cumsum(np.bincount(block, minlength=len(heads))))
    return Blocks(np.append(heads, m), pairs.astype(np.int32), first)


def restore(
    rows: npt.NDArray[Any], steps: Floats, merges: Merges, mixing: Floats, leaf: Ints
) -> tuple[npt.NDArray[np.float32], Floats]:
    """(m, C) float32 coefficients of leaves by number, the last of them left at 0, and (m,) what stands there instead.

    rows, steps, merges: of kernels.octree.haar.inverse(). A coefficient is the sum over the channels but the last, from
    the first on, of the channel times mixing (C - 1, C - 1), whose rows are the channels. leaf (m,): each point's
    number.
    """
    blocks = blocks_of(merges)
    b = len(blocks.heads) - 1
    low, high = (np.searchsorted(blocks.heads, each[: b - 1]).astype(np.int32) for each in (merges.low, merges.high))
    sums = inverse(rows[:b], steps, merges._replace(low=low, high=high))
    values, last = np.zeros(rows.shape, np.float32), np.empty(len(rows))
    on_every_core(
        lambda first, step: _restore(rows, steps, merges, blocks, sums, mixing, leaf, values, last, first, step)
    )
    return values, last


@compiled()
def _restore(
    rows: npt.NDArray[Any],
    steps: Floats,
    merges: Merges,
    blocks: Blocks,
    sums: Floats,
    mixing: Floats,
    leaf: Ints,
    values: npt.NDArray[np.float32],
    last: Floats,
    first: int,
    step: int,
) -> None:
    """Every step-th block."""
    C = len(steps)
    own = np.empty(C - 1)
    low, high, low_count, high_count = merges.low, merges.high, merges.low_count, merges.high_count
    for block in range(first, len(sums), step):
        begin = blocks.heads[block]
        points = np.empty((blocks.heads[block + 1] - begin, C))
        points[0] = sums[block]
        for i in range(blocks.first[block], blocks.first[block + 1]):
            pair = blocks.pairs[i]
            p = np.sqrt(low_count[pair] / (low_count[pair] + high_count[pair]))
            q = np.sqrt(high_count[pair] / (low_count[pair] + high_count[pair]))
            a, b = low[pair] - begin, high[pair] - begin
            for c in range(C):
                total, difference = points[a, c], rows[pair + 1, c] * steps[c]
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
