"""Which texels a triangle shows."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.surface.raster import covered_texels


def test_a_triangle_and_its_rim_by_hand() -> None:
    # From texel centre (2, 2) to (5, 2) and (2, 5): itself and one texel around.
    corners = (np.array([[2, 2], [5, 2], [2, 5]]) + 0.5) / 8
    covered = covered_texels(corners.astype(np.float32), np.array([[0, 1, 2]], np.uint32), 8, 8)
    y, x = np.mgrid[:8, :8]
    expected = (x >= 1) & (y >= 1) & (x + y <= 7 + np.sqrt(2) - 1e-6) & (x <= 6) & (y <= 6)
    np.testing.assert_array_equal(covered, expected)


def test_orientation_does_not_matter_and_a_point_covers_its_texels() -> None:
    corners = np.array([[0.1, 0.1], [0.9, 0.2], [0.3, 0.8]], np.float32)
    faces = np.array([[0, 1, 2]], np.uint32)
    np.testing.assert_array_equal(
        covered_texels(corners, faces, 16, 16), covered_texels(corners, faces[:, ::-1].copy(), 16, 16)
    )
    assert 1 <= covered_texels(np.full((3, 2), 0.5, np.float32), faces, 16, 16).sum() <= 9
