from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from nerfbake.kernels.network.planes import PackedPlanes, plane_features


def test_one_scale_by_hand() -> None:
    """Planes across x and y (2 x 2 nodes), x and z (2 x 1), y and z (2 x 1), of one feature."""
    values = np.array([1, 2, 3, 4, 10, 20, 5, 7], np.float32)
    planes = PackedPlanes(values, np.array([[2, 2, 1]]), 1)
    points = np.array([[0, 0, 0], [1, 0, 0.5], [0.5, 0.5, 1], [1, 1, 1]], np.float32)
    expected = [1 * 10 * 5, 2 * 20 * 5, 2.5 * 15 * 6, 4 * 20 * 7]
    assert_allclose(plane_features(planes, points, concatenated=True), [expected])


def test_scales_are_concatenated_or_added() -> None:
    nodes, C = np.array([[2, 3, 4], [3, 5, 2]]), 2
    count = C * sum(x * y + x * z + y * z for x, y, z in nodes.tolist())
    planes = PackedPlanes(np.random.default_rng(0).random(count, np.float32), nodes, C)
    points = np.random.default_rng(1).random((2000, 3), np.float32)
    apart = plane_features(planes, points, concatenated=True)
    assert_allclose(plane_features(planes, points, concatenated=False), apart[:2] + apart[2:], rtol=1e-6)
    assert_allclose(plane_features(planes, points * 3, concatenated=True), plane_features(
        planes, np.minimum(points * 3, 1), concatenated=True))  # fmt: skip
