from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.errors import InvalidScene
from nerfbake.scene.network import Frequencies
from nerfbake.scene.network_grid import NetworkGrid, Perceptrons

DOMAIN = np.array([[-1.0, 0.0, 2.0], [1.0, 3.0, 3.0]])
NO_SINES = Frequencies(np.zeros(0))


def grid(cells: tuple[int, int, int] = (2, 3, 1)) -> NetworkGrid:
    """Network n has the density x + 2 y + 3 z + 10 n in its cell, and the logits n, n + the direction's z, 0."""
    n = int(np.prod(cells))
    numbers = np.arange(n, dtype=np.float32)
    trunk = np.zeros((n, 2, 3), np.float32)
    trunk[:, 1] = [1, 2, 3]
    head = np.zeros((n, 3, 4), np.float32)
    head[:, 1, 3] = 1
    biases = np.stack([numbers, numbers, 0 * numbers], axis=1)
    inner = Perceptrons((trunk,), (np.stack([0 * numbers, 10 * numbers], axis=1),))
    return NetworkGrid(DOMAIN, cells, NO_SINES, inner, NO_SINES, Perceptrons((head,), (biases,)))


def test_each_cell_has_its_own_network_and_coordinates() -> None:
    network = grid()
    points = np.array([[-0.5, 0.5, 2.5], [0.75, 2.75, 2.5], [-1.0, 1.0, 2.0], [0.5, 1.5, 2.875]], np.float32)
    numbers = np.array([0, 5, 1, 4])  # (x 3 + y) 1 + z
    places = np.array([[0, 0, 0], [0.5, 0.5, 0], [-1, -1, -1], [0, 0, 0.75]])
    features = network.features(points)
    assert_array_equal(features[-1], numbers)
    assert_allclose(network.density_of(features), np.maximum(places @ [1, 2, 3] + 10 * numbers, 0), atol=1e-6)
    logits = network.logits(features, np.array([[0, 0, 1.0]] * 4))
    assert_allclose(logits, [numbers, numbers + 1, 0 * numbers], atol=1e-6)


def test_points_outside_of_the_domain_count_as_in_the_nearest_cell() -> None:
    features = grid().features(np.array([[-9, 9, 9], [1, 3, 3]], np.float32))
    assert_array_equal(features[-1], [2, 5])


def test_a_network_is_needed_for_each_cell() -> None:
    with pytest.raises(InvalidScene, match="the networks are 6 and 6 in 2 x 2 x 2 cells; allowed: one for each cell"):
        NetworkGrid(DOMAIN, (2, 2, 2), NO_SINES, grid().trunk, NO_SINES, grid().head)
    with pytest.raises(InvalidScene, match="the networks of colours take 4 inputs; allowed: 10"):
        NetworkGrid(DOMAIN, (2, 3, 1), NO_SINES, grid().trunk, Frequencies(np.ones(1)), grid().head)
    with pytest.raises(InvalidScene, match="layer 1 of the networks"):
        Perceptrons(
            (np.ones((2, 4, 3), np.float32), np.ones((2, 1, 5), np.float32)), (np.ones((2, 4), np.float32),) * 2
        )


def test_nan_is_a_problem() -> None:
    network = grid()
    network.head.weights[0][3, 1, 2] = np.nan
    assert [problem.found for problem in network.problems()] == ["is nan"]
