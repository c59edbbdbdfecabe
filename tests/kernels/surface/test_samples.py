"""Samples in bricks, against dense grids."""

from __future__ import annotations

from itertools import product

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.surface.samples import (
    EDGE,
    blur,
    brick_places,
    least_along_rays,
    mark_bricks,
    sample_at,
    spread,
)
from tests.support.meshes import straight_down

LATTICE = np.column_stack([np.eye(3), [6.0, 6.0, 6.0]])  # samples 1 apart; sample (6, 6, 6) is the world's origin
OPTICS = np.array([4.0, 4.0, 2.5, 1.5])


def bricked(grid: npt.NDArray[np.float32]) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.float32]]:
    """All bricks of a dense grid, whose edges are multiples of 4."""
    X, Y, Z = (edge // EDGE for edge in grid.shape)
    values = grid.reshape(X, EDGE, Y, EDGE, Z, EDGE).transpose(0, 2, 4, 1, 3, 5).reshape(-1, EDGE**3)
    return np.arange(X * Y * Z, dtype=np.int32).reshape(X, Y, Z), np.ascontiguousarray(values)


def test_bricks_near_depths_are_marked() -> None:
    # One pixel looks straight down from z = 2 and sees something 1.5 below: sample (6, 6, 6.5) of the lattice.
    depth = np.full((3, 5), np.inf, np.float32)
    depth[1, 2] = 1.5
    pose = np.ascontiguousarray(straight_down().pose[:3])
    middle = {(1, 1, 1)}
    above = set(product((1, 2), repeat=3))
    below = set(product((0, 1, 2), (0, 1, 2), (1, 2)))
    for reach, expected in ((1.0, middle), (2.0, above), (3.0, below)):
        held = np.zeros((4, 4, 4), bool)
        mark_bricks(depth, pose, OPTICS, LATTICE, reach, held)
        assert {tuple(place) for place in np.argwhere(held).tolist()} == expected


def test_values_are_blurred_and_spread_as_in_a_dense_grid() -> None:
    random = np.random.default_rng(0)
    grid = random.random((12, 8, 8)).astype(np.float32)
    top, values = bricked(grid)
    top[0, 0, 0] = -1  # a hole
    grid[:4, :4, :4] = np.nan
    places = brick_places(top)
    top[top >= 0] = np.arange(len(places))
    values = np.ascontiguousarray(values[1:])
    out = np.empty_like(values)
    blur(top, places, values, 1.0, out)
    held = np.empty(values.shape, bool)
    spread(top, places, values > 0.98, 2, held)
    for brick, place in enumerate(places):
        for cell, within in enumerate(product(range(EDGE), repeat=3)):
            at = place * EDGE + within
            low, high = np.maximum(at - 1, 0), at + 2
            near = grid[tuple(slice(a, b) for a, b in zip(low, high, strict=True))]
            steps = np.indices(near.shape).transpose(1, 2, 3, 0) + low - at
            weights = np.where(np.isnan(near), 0, (2 - np.abs(steps)).prod(axis=-1))
            np.testing.assert_allclose(
                out[brick, cell], (weights * np.nan_to_num(near)).sum() / weights.sum(), rtol=1e-5
            )
            around = grid[tuple(slice(max(a - 2, 0), a + 3) for a in at)]
            assert held[brick, cell] == (around > 0.98).any()


def test_the_least_value_along_a_ray() -> None:
    # From above, values fall from 12 at the top to 1 at z = 1; only the column in the middle has a smaller one.
    grid = np.broadcast_to(np.arange(12, dtype=np.float32), (12, 12, 12)).copy()
    grid[6, 6, 3] = -5
    top, values = bricked(grid)
    camera = straight_down(5, 3, 400.0, 20.0)
    out = np.empty((3, 5), np.float32)
    optics = np.array([400.0, 400, 2.5, 1.5])
    least_along_rays(top, values, LATTICE, np.ascontiguousarray(camera.pose[:3]), optics, 100.0, out)
    assert out[1, 2] < -3.5
    np.testing.assert_array_less(np.full(3, -5.01), out[:, 2])
    top[:] = -1
    least_along_rays(top, values, LATTICE, np.ascontiguousarray(camera.pose[:3]), optics, 100.0, out)
    assert (out == 100).all()


def test_there_is_no_sample_outside_and_in_no_brick() -> None:
    top, values = bricked(np.zeros((4, 4, 4), np.float32))
    assert sample_at(top, values, 3, 3, 3) == 0
    for place in ((4, 0, 0), (-1, 0, 0), (0, 0, 4)):
        assert sample_at(top, values, *place) == np.inf
