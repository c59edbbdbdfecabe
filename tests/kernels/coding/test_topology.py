from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake.kernels.coding.topology import DEEP, ORPHAN, SOUND, decode_masks, encode_masks, nodes_of
from tests.support.quantised import random_quantised

seeds = st.integers(0, 10_000)


def test_neighbours_by_hand() -> None:
    # The root has children in octants 0 and 1; the first has its own in octant 1, the second in octants 0 and 6.
    masks = np.array([0b11, 0b10, 0b1000001, 0, 1, 0], np.uint8)
    nodes = nodes_of(masks)
    assert nodes.level.tolist() == [0, 1, 1, 2, 2, 2]
    assert nodes.first.tolist() == [1, 3, 4, 6, 6, 7]
    none = [-1] * 6
    assert nodes.beside.tolist() == [
        none, [-1, -1, -1, 2, -1, -1], [1, *none[1:]], [-1, -1, -1, 4, -1, -1], [3, *none[1:]], none,
    ]  # fmt: skip


@given(seeds, st.integers(0, 4), st.floats(0.1, 1))
def test_masks_come_back_and_no_byte_is_left(seed: int, levels: int, fill: float) -> None:
    masks = random_quantised(seed, levels=levels, fill=fill).masks
    data = encode_masks(masks)
    back, found, used = decode_masks(data, len(masks), levels)
    assert_array_equal(back, masks)
    assert (found, used) == (SOUND, len(data))


def test_a_flat_sheet_takes_a_small_part_of_its_masks() -> None:
    # Every node of the last level but one has the lower four octants: a plane, of which nothing is unexpected.
    masks = np.array([0b1111] * sum(4**level for level in range(6)), np.uint8)
    assert len(encode_masks(masks)) < len(masks) / 20


@pytest.mark.parametrize(("c", "levels", "wrong"), [(3, 3, ORPHAN), (9, 1, DEEP)])
def test_masks_that_no_octree_has_are_told(c: int, levels: int, wrong: int) -> None:
    masks = np.zeros(9, np.uint8)
    masks[0] = 255 if wrong == DEEP else 1
    assert decode_masks(encode_masks(masks[: c if wrong == DEEP else 2]), c, levels)[1] == wrong
