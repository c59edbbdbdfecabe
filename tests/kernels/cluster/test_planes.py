"""Clusters that are planes."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.cluster import lloyd, planes

RANDOM = np.random.default_rng(4)


def two_planes() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points on two planes over the same features, and which is whose."""
    features = RANDOM.random((400, 3)).astype(np.float32)
    label = (np.arange(400) % 2).astype(np.int32)
    slopes = RANDOM.normal(size=(2, 4, 6))
    x = np.insert(features, 0, 1, axis=1)
    points = (x[:, None] @ slopes[label])[:, 0]
    return points.astype(np.float32), features, label


def test_a_fit_goes_through_points_that_lie_in_a_plane() -> None:
    points, features, label = two_planes()
    weight = RANDOM.random(400) + 0.1
    fitted = planes.fit(points, features, weight, label, 2, 1e-12)
    shown = (np.insert(features, 0, 1, axis=1)[:, None] @ fitted[label])[:, 0]
    np.testing.assert_allclose(shown, points, atol=1e-4)


def test_points_go_to_the_plane_they_lie_in_and_an_empty_one_gets_none() -> None:
    points, features, label = two_planes()
    fitted = planes.fit(points, features, np.ones(400), label, 3, 1e-12)
    cells = lloyd.bound_cells(points, np.array([0, 150, 400]))
    candidates = planes.nearest_clusters(cells, RANDOM.normal(size=(3, 6)).astype(np.float32), 16)
    assert candidates.shape == (2, 3)
    np.testing.assert_array_equal(planes.nearest_planes(points, features, cells, candidates, fitted), label)


def test_the_candidates_are_the_nearest() -> None:
    points = RANDOM.normal(size=(300, 5)).astype(np.float32)
    cells = lloyd.bound_cells(points, np.arange(0, 301, 3))
    centres = RANDOM.normal(size=(50, 5)).astype(np.float32)
    squares = ((cells.mean[:, None] - centres) ** 2).sum(axis=2)
    expected = np.sort(np.argsort(squares, axis=1)[:, :7], axis=1)
    np.testing.assert_array_equal(np.sort(planes.nearest_clusters(cells, centres, 7), axis=1), expected)
