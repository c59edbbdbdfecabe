from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake.kernels.coding.coefficients import SOUND, TOO_SHORT, decode_values, encode_values
from nerfbake.kernels.coding.pairs import pairs_of
from tests.support.quantised import random_quantised


@settings(max_examples=40)
@given(st.integers(0, 10_000), st.sampled_from(["RGBA", "SH1", "SH4", "SH9", "SH16", "SH25"]), st.integers(-3, 7))
def test_values_come_back_whatever_their_size_and_streams(seed: int, data_format: str, digits: int) -> None:
    octree = random_quantised(seed, levels=2, data_format=data_format, spread=10.0**digits / 60)
    pairs, C = pairs_of(octree.masks, octree.m), octree.values.shape[1]
    ends = sorted({*np.random.default_rng(seed).integers(1, C, 2).tolist(), C})
    streams = encode_values(octree.values, pairs, ends)
    back = np.zeros_like(octree.values)
    back[0] = octree.values[0]
    assert decode_values(streams, back, pairs, ends) == (SOUND, [len(stream) for stream in streams])
    assert_array_equal(back, octree.values)


def test_what_is_read_only_is_encoded() -> None:
    octree = random_quantised(1)
    pairs, before = pairs_of(octree.masks, octree.m), octree.values.copy()
    ends = [octree.values.shape[1]]
    streams = encode_values(octree.values, pairs, ends)
    assert_array_equal(octree.values, before)
    before.flags.writeable = False
    assert [each.tobytes() for each in encode_values(before, pairs, ends)] == [each.tobytes() for each in streams]


def test_neighbours_that_go_the_same_way_are_believed() -> None:
    """Rows that repeat what touches them at -z, times one or minus one, cost a quarter less than rows that do not."""
    octree = random_quantised(2, levels=4, fill=1.0, data_format="SH4")
    pairs, random = pairs_of(octree.masks, octree.m), np.random.default_rng(0)
    own = random.integers(-8, 9, octree.values.shape).astype(np.int32)
    alike = own.copy()
    for row, reference in enumerate(pairs.references[:, 2]):
        if reference:
            alike[row] = alike[reference] * (1 if random.random() < 0.5 else -1)
    (apart,), (together,) = (encode_values(values, pairs, [13]) for values in (own, alike))
    assert len(together) < 0.8 * len(apart)


@pytest.mark.parametrize("cut", [1, 20, 100])
def test_a_stream_that_ends_too_early_is_told(cut: int) -> None:
    octree = random_quantised(3, levels=4)
    pairs, ends = pairs_of(octree.masks, octree.m), [octree.values.shape[1]]
    (stream,) = encode_values(octree.values, pairs, ends)
    found, (used,) = decode_values([stream[:-cut]], np.zeros_like(octree.values), pairs, ends)
    assert found == TOO_SHORT or used != len(stream) - cut
