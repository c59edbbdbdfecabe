"""Lloyd's rounds: pruned as if they were not, and never worse than before."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from nerfbake.kernels.cluster import lloyd
from nerfbake.kernels.cluster.colours import codes_of, colours_of, runs

RANDOM = np.random.default_rng(8)


def clouds(m: int) -> tuple[np.ndarray, np.ndarray]:
    """Points along a bent sheet, sorted into cells."""
    codes = np.unique(codes_of(RANDOM.integers(0, 256, (m, 3), np.uint8)))
    f = colours_of(codes) / 255
    points = np.stack([f[:, 0], f[:, 1], f[:, 2], f[:, 0] * f[:, 1], np.sin(5 * f[:, 2])], axis=1)
    return (100 * points).astype(np.float32), runs(codes >> np.uint32(15))


@pytest.mark.parametrize("K", [1, 5, 300])
def test_pruning_changes_no_label(K: int) -> None:
    points, start = clouds(4000)
    centres = RANDOM.permutation(points)[:K]
    label, distance = lloyd.nearest_centres(points, lloyd.bound_cells(points, start), centres)
    squares = ((points[:, None] - centres[None]).astype(float) ** 2).sum(axis=2)
    np.testing.assert_allclose(distance, squares.min(axis=1), rtol=1e-4, atol=1e-3)
    np.testing.assert_allclose(squares[np.arange(len(points)), label], squares.min(axis=1), rtol=1e-4, atol=1e-3)


def test_a_round_never_raises_the_inertia() -> None:
    points, start = clouds(5000)
    cells, weight = lloyd.bound_cells(points, start), RANDOM.integers(1, 50, len(points)).astype(float)
    centres = lloyd.seed(points, weight, 40, np.random.default_rng(0))
    inertia = []
    for _ in range(8):
        label, distance = lloyd.nearest_centres(points, cells, centres)
        inertia.append(float(distance.astype(float) @ weight))
        centres = lloyd.move(points, weight, label, centres)
    assert all(later <= earlier * (1 + 1e-6) for earlier, later in pairwise(inertia))
    assert inertia[-1] < inertia[0]


def test_a_centre_moves_to_its_weighted_mean_and_an_idle_one_stays() -> None:
    points, weight = np.array([[0], [4], [10]], np.float32), np.array([1.0, 3.0, 5.0])
    label = np.array([0, 0, 2], np.int32)
    assert lloyd.move(points, weight, label, np.array([[1], [7], [9]], np.float32)).tolist() == [[3], [7], [10]]


def test_the_nearest_member_is_the_first_of_equals() -> None:
    label, distance = np.array([1, 0, 1, 1], np.int32), np.array([2, 5, 1, 1], np.float32)
    assert lloyd.nearest_members(label, distance, 3).tolist() == [1, 2, -1]


def test_groups_are_weighted_means() -> None:
    groups = lloyd.group(np.array([[0], [4], [10]], np.float32), np.array([1.0, 3.0, 5.0]), np.array([0, 2, 3]))
    assert groups.mean.tolist() == [[3], [10]]
    assert groups.weight.tolist() == [4, 5]
