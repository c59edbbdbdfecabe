from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.octree import haar


def test_three_leaves_by_hand() -> None:
    # Octants 0, 1 and 6 of a root of one level: 0 and 1 meet in the first bit, then 6 meets both in the last.
    codes, order = haar.leaf_codes(haar.levels_of(np.array([0b01000011], np.uint8), 1), 1)
    assert codes.tolist() == [0, 1, 6]
    assert order.tolist() == [0, 1, 2]
    merges = haar.merges_of(codes, 1)
    assert merges.low.tolist() == [0, 0]
    assert merges.high.tolist() == [2, 1]
    assert merges.low_count.tolist() == [2, 1]
    assert merges.high_count.tolist() == [1, 1]
    assert merges.ends.tolist() == [1, 1, 2]
    assert merges.rows.tolist() == [0, 2, 1]
    points = np.array([[1.0], [3.0], [5.0]])
    haar.forward(points, merges, haar.blocks_of(merges))
    # The mean is 3, times the root of 3; 3 - 1 and 5 - 2 in orthonormal units.
    assert_allclose(points[merges.rows, 0], [9 / np.sqrt(3), 3 * np.sqrt(2 / 3), np.sqrt(2)], rtol=1e-15)


def test_a_larger_leaf_enters_at_its_own_level() -> None:
    # The root has a leaf in octant 0 and a node in octant 1, which has two voxels, 0 and 7.
    masks = np.array([0b11, 0, 0b10000001], np.uint8)
    codes, order = haar.leaf_codes(haar.levels_of(masks, 2), 2)
    assert codes.tolist() == [0, 8, 15]
    assert order.tolist() == [0, 1, 2]
    merges = haar.merges_of(codes, 2)
    assert merges.ends.tolist() == [0, 0, 1, 2, 2, 2]
    assert merges.high.tolist() == [1, 2]
    assert merges.high_count.tolist() == [2, 1]


@given(st.integers(0, 2**32), st.integers(1, 300), st.integers(1, 4))
def test_the_transform_is_orthonormal_and_comes_back(seed: int, m: int, levels: int) -> None:
    random = np.random.default_rng(seed)
    codes = np.unique(random.integers(0, 8**levels, m))
    merges = haar.merges_of(codes, levels)
    assert merges.ends[-1] == len(codes) - 1
    assert_array_equal(np.sort(merges.rows), np.arange(len(codes)))
    points = random.normal(size=(len(codes), 3))
    made = points.copy()
    haar.forward(made, merges, haar.blocks_of(merges))
    assert_allclose((made**2).sum(axis=0), (points**2).sum(axis=0))
    assert_allclose(made[0], points.sum(axis=0) / np.sqrt(len(codes)), atol=1e-12)
    rows, steps = made[merges.rows], np.array([1, 2, 0.5])
    assert_allclose(haar.inverse(rows / steps, steps, merges), points, atol=1e-12)


def test_a_single_leaf_is_its_own_mean() -> None:
    codes, _ = haar.leaf_codes(haar.levels_of(np.zeros(1, np.uint8), 3), 3)
    merges = haar.merges_of(codes, 3)
    points = np.array([[7.0]])
    haar.forward(points, merges, haar.blocks_of(merges))
    assert points.tolist() == [[7.0]]
    assert merges.ends.tolist() == [0] * 9
