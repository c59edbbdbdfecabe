"""Smaller pictures, against NumPy's means and against pictures that are rendered smaller."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake import build_field, orbit_cameras, render_field, sample_n3tree
from nerfbake.kernels.picture.reduction import reduced_picture


def test_a_reduced_picture_has_the_means_of_its_blocks() -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (13, 20, 4)).astype(np.uint8)
    pixels[..., 3] = 255
    blocks = pixels[:12, :18].reshape(4, 3, 6, 3, 4).astype(float)
    assert_array_equal(reduced_picture(pixels, 3), np.floor(blocks.mean(axis=(1, 3)) + 0.5))
    assert_array_equal(reduced_picture(pixels, 1), pixels)


def test_alpha_weights_the_colours_of_a_reduced_picture() -> None:
    pixels = np.zeros((2, 6, 4), np.uint8)
    pixels[0, 0], pixels[1, 1] = (200, 100, 0, 255), (0, 100, 40, 85)
    pixels[:, 2:4], pixels[:, 4:] = (9, 8, 7, 255), (6, 5, 4, 255)
    pixels[1, 5, 3] = 254
    made = reduced_picture(pixels, 2)
    assert_array_equal(made[0], [(150, 100, 10, 85), (9, 8, 7, 255), (6, 5, 4, 254)])


def test_a_reduced_picture_shows_what_its_camera_sees() -> None:
    field = build_field(sample_n3tree(resolution=16))
    camera = orbit_cameras(field, width=41, height=30).cameras[0]
    made = reduced_picture(render_field(field, camera, background=None, samples=4).pixels, 2)
    seen = render_field(field, camera.reduced(2), background=None, samples=8).pixels
    held = seen[..., 3] > 128
    assert held.sum() > 30
    assert np.abs(made[..., 3].astype(int) - seen[..., 3]).max() <= 12
    assert np.abs(made[held].astype(int) - seen[held]).max() <= 12
