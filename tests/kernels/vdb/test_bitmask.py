from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake.kernels.vdb.bitmask import exclusive_sum, group_bits, popcount, prefix_counts, slots_of


def test_slots_become_bits() -> None:
    parents, masks = group_bits(np.array([5 << 7 | 2, 5 << 7 | 3, 5 << 7 | 64, 9 << 7 | 127]), 7)
    assert_array_equal(parents, [5, 9])
    assert_array_equal(masks, np.array([[0b1100, 1], [0, 1 << 63]], np.uint64))
    assert_array_equal(popcount(masks), [3, 1])
    assert_array_equal(prefix_counts(masks), [[0, 2], [0, 0]])


def test_nothing_has_no_parents() -> None:
    parents, masks = group_bits(np.zeros(0, np.int64), 9)
    assert (parents.shape, masks.shape) == ((0,), (0, 8))
    assert all(len(array) == 0 for array in slots_of(masks))


@given(st.sets(st.integers(0, 5 << 9), max_size=200))
def test_the_bits_are_the_slots(keys: set[int]) -> None:
    ordered = np.array(sorted(keys), np.int64)
    parents, masks = group_bits(ordered, 9)
    row, slot = slots_of(masks)
    assert_array_equal(parents[row] << 9 | slot, ordered)


def test_exclusive_sum() -> None:
    assert_array_equal(exclusive_sum(np.array([3, 1, 2])), [0, 3, 4])
