from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from nerfbake.kernels.coding.pairs import pairs_of
from nerfbake.kernels.octree import haar
from tests.support.quantised import random_quantised


def test_one_node_by_hand() -> None:
    # Octants 0, 1, 3, 4, 5, 7: a pair along z, one along y in each half, along x at (y, z) = (0, 0) and (0, 1).
    pairs = pairs_of(np.array([0b10111011], np.uint8), 6)
    assert pairs.slot.tolist() == [0, 0, 1, 2, 3, 5]
    # The upper of two pairs along y, and along x, touches the lower one at -z.
    assert pairs.references.tolist() == [[0] * 4, [0] * 4, [0] * 4, [0, 0, 2, 0], [0] * 4, [0, 0, 4, 0]]


def test_pairs_of_neighbouring_nodes_touch() -> None:
    # Two nodes beside each other along x, both full: their pairs refer to those in the first, and to the root's.
    pairs = pairs_of(np.array([0b11, 255, 255], np.uint8), 16)
    assert pairs.slot.tolist() == [0, 3, 0, 0, 1, 2, 1, 2, *(3, 4, 5, 6) * 2]
    assert pairs.references[3].tolist() == [2, 0, 0, 0]
    assert pairs.references[7].tolist() == [5, 0, 6, 0]
    assert pairs.references[15].tolist() == [11, 14, 13, 1]


@given(st.integers(0, 10_000), st.integers(0, 4))
def test_there_are_as_many_pairs_as_the_transform_has_and_all_refer_to_earlier_ones(seed: int, levels: int) -> None:
    octree = random_quantised(seed, levels=levels)
    pairs = pairs_of(octree.masks, octree.m)
    codes, _ = haar.leaf_codes(haar.levels_of(octree.masks, levels), levels)
    counts = np.diff(haar.merges_of(codes, levels).ends, prepend=0)  # of each binary level: z, y, x of the root, ...
    axes = np.array([2, 1, 1, 0, 0, 0, 0])[pairs.slot[1:]]
    assert np.bincount(axes, minlength=3).tolist() == [int(counts[2 - axis :: 3].sum()) for axis in range(3)]
    assert (pairs.references[1:] < np.arange(1, octree.m)[:, None]).all()
