"""Leaves are restored block by block to the bits that the whole transform gives."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake.kernels.octree import haar


@given(st.integers(0, 2**32), st.integers(1, 400), st.integers(1, 6), st.integers(1, 5))
def test_blocks_give_the_bits_of_the_whole_transform(seed: int, m: int, levels: int, width: int) -> None:
    """Up to six levels are eighteen bits, of which a block has twelve."""
    random = np.random.default_rng(seed)
    codes = np.unique(random.integers(0, 8**levels, m))
    merges, m = haar.merges_of(codes, levels), len(codes)
    rows = random.integers(-1000, 1000, (m, width + 1)).astype(np.int32)
    steps, mixing, leaf = random.random(width + 1), random.normal(size=(width, width)), random.permutation(m)
    values, last = haar.restore(rows, steps, merges, mixing, leaf)
    points = haar.inverse(rows, steps, merges)
    sums = np.zeros((m, width))
    for channel in range(width):
        sums += points[:, channel, None] * mixing[channel]
    assert_array_equal(values[leaf, :-1], sums.astype(np.float32))
    assert_array_equal(last[leaf], points[:, -1])
    assert not values[:, -1].any()


@given(st.integers(0, 2**32), st.integers(1, 400), st.integers(1, 6))
def test_the_transform_in_blocks_has_the_bits_of_that_pair_by_pair(seed: int, m: int, levels: int) -> None:
    random = np.random.default_rng(seed)
    merges = haar.merges_of(np.unique(random.integers(0, 8**levels, m)), levels)
    points = random.normal(size=(len(merges.low) + 1, 3)).astype(np.float32)
    expected = points.copy()
    for a, b, low, high in zip(*(each[::-1] for each in merges[:4]), strict=True):
        p, q = np.sqrt(low / (low + high)), np.sqrt(high / (low + high))
        below, above = expected[a].astype(float), expected[b].astype(float)
        expected[a], expected[b] = p * below + q * above, p * above - q * below
    haar.forward(points, merges, haar.blocks_of(merges))
    assert_array_equal(points, expected)


@pytest.mark.parametrize("levels", [1, 4, 5, 10])
def test_a_block_is_a_cube(levels: int) -> None:
    codes = np.unique(np.random.default_rng(levels).integers(0, 8**levels, 3000))
    merges = haar.merges_of(codes, levels)
    blocks = haar.blocks_of(merges)
    cube = codes >> 12
    assert_array_equal(blocks.heads, np.append(np.flatnonzero(np.append(True, cube[1:] != cube[:-1])), len(codes)))
    assert_array_equal(np.sort(blocks.pairs), np.arange(len(blocks.heads) - 2, len(codes) - 1))
    for block in range(len(blocks.heads) - 1):
        own = blocks.pairs[blocks.first[block] : blocks.first[block + 1]]
        assert (np.diff(own) > 0).all()
        assert ((merges.low[own] >= blocks.heads[block]) & (merges.high[own] < blocks.heads[block + 1])).all()
