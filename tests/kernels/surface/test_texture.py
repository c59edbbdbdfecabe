"""Texture lookups by hand."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.surface.texture import bilinear, nearest_texel

TEXTURE = np.array([[[0], [100]], [[200], [40]]], np.uint8)


def test_texels_are_met_at_their_centres_and_mixed_between_them() -> None:
    places = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.5, 0.25], [0.5, 0.5]])
    np.testing.assert_allclose(255 * bilinear(TEXTURE, places)[:, 0], [0, 100, 200, 50, 85], atol=1e-4)


def test_the_texture_repeats() -> None:
    places = np.array([[0.0, 0.25], [1.0, 0.25], [-3.75, 8.25], [1e6 + 0.25, 0.75]])
    np.testing.assert_allclose(255 * bilinear(TEXTURE, places)[:, 0], [50, 50, 0, 200], atol=1e-4)
    np.testing.assert_array_equal(
        nearest_texel(TEXTURE, np.array([[1.3, 0.2], [-0.1, 0.9], [1.0, 1.0]]))[:, 0], [0, 40, 0]
    )


def test_coordinates_just_below_a_whole_number_stay_in_the_texture() -> None:
    below = np.nextafter(np.float32(0), np.float32(-1))  # minus its floor it rounds to 1
    assert nearest_texel(TEXTURE, np.array([[below, below]], np.float32)).shape == (1, 1)
    assert np.isfinite(bilinear(TEXTURE, np.array([[below, below]], np.float32))).all()
