from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.network.hash_grid import Levels, grid_features


def level(table: Singles, scale: float, *, dense: int = 0, shift: float = 0.0) -> Levels:
    first = np.array([0, len(table)], np.int64)
    return Levels(table, first, np.array([scale], np.float32), shift, np.array([dense], np.int64))


def test_a_dense_level_by_hand() -> None:
    # 3^3 nodes, x fastest; the value of a node is x + 10 y + 100 z.
    z, y, x = np.meshgrid(*[np.arange(3)] * 3, indexing="ij")
    table = (x + 10 * y + 100 * z).reshape(-1, 1).astype(np.float32)
    points = np.array([[0, 0, 0], [0.5, 0, 0], [0, 0.25, 0.75], [0.75, 0.5, 0.25]], np.float32)
    assert_allclose(grid_features(level(table, 2, dense=3), points)[0], [0, 1, 155, 61.5], rtol=1e-6)


def test_a_dense_level_wraps_behind_its_last_node() -> None:
    # With a shift of 1/2 the point 1 lies between the last node, 2, and a node that the level does not have.
    table = np.arange(27, dtype=np.float32)[:, None]
    found = grid_features(level(table, 2, dense=3, shift=0.5), np.array([[1, 0, 0]], np.float32))[0, 0]
    rows = [(2 + a) + 3 * b + 9 * c for c in (0, 1) for b in (0, 1) for a in (0, 1)]
    assert found == np.mean([row % 27 for row in rows])


def test_a_hashed_level_by_its_formula() -> None:
    rng = np.random.default_rng(1)
    table, points = rng.normal(size=(64, 2)).astype(np.float32), rng.random((50, 3)).astype(np.float32)
    place = points * np.float32(37)
    low = np.floor(place)
    expected = np.zeros((50, 2))
    for corner in np.ndindex(2, 2, 2):
        node = (low + corner).astype(np.int64)
        row = (node[:, 0] ^ node[:, 1] * 2654435761 ^ node[:, 2] * 805459861) % 64
        weight = np.where(corner, place - low, 1 - (place - low)).prod(axis=1)
        expected += weight[:, None] * table[row]
    assert_allclose(grid_features(level(table, 37), points).T, expected, atol=1e-5)


def test_levels_follow_each_other_with_their_features_together() -> None:
    table = np.arange(12, dtype=np.float32).reshape(6, 2)  # level 0: 4 rows, level 1: 2
    levels = Levels(table, np.array([0, 4, 6]), np.array([1, 1], np.float32), 0.0, np.array([0, 1]))
    found = grid_features(levels, np.zeros((3, 3), np.float32))
    assert_array_equal(found[:, 0], [0, 1, 8, 9])
    assert found.shape == (4, 3)
