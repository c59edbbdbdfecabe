from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake.kernels.picture.drawing import ALL_COLOURS, UNKNOWN, nearest_colour


@given(st.integers(0, 2**32), st.integers(1, 256))
def test_every_pixel_gets_the_closest_colour_the_first_of_equals(seed: int, K: int) -> None:
    random = np.random.default_rng(seed)
    pixels = random.integers(0, 256, (50, 3), np.uint8)
    palette = random.integers(0, 256, (K, 3), np.uint8)
    known = np.full(ALL_COLOURS, UNKNOWN, np.int16)
    distances = np.square(pixels[:, None].astype(int) - palette).sum(axis=2)
    assert_array_equal(nearest_colour(pixels, palette, known), distances.argmin(axis=1))
    assert_array_equal(nearest_colour(pixels, palette, known), distances.argmin(axis=1))
