"""Planes on which pictures are alike, and the smooth choice among them."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.fit.stereo import UNSEEN, compare_planes, smooth_costs

HEIGHT, WIDTH, SHIFT = 20, 30, 4
PLANES = np.array([0.0, 2.0, SHIFT, 6.0])


def alike(others: Singles, used: bool = True) -> Singles:
    """Compare a picture of noise with others, in which a plane of inverse depth w lies w pixels further right."""
    found = np.empty((len(PLANES), HEIGHT, WIDTH), np.float32)
    seen, turns, moves = np.full(others.shape, used), np.stack([np.eye(3)] * len(others)), np.eye(3)[[0] * len(others)]
    compare_planes(noise(), others, seen, turns, moves, PLANES, found)
    return found


def noise() -> Singles:
    return np.random.default_rng(0).uniform(size=(HEIGHT, WIDTH)).astype(np.float32)


def test_pictures_are_alike_on_the_plane_that_they_show() -> None:
    found = alike(np.roll(noise(), SHIFT, axis=1)[None])
    inner = found[:, 3:-3, 3 : WIDTH - SHIFT - 3]
    assert inner[2].min() > 0.999
    assert inner[[0, 1, 3]].max() < 0.8


def test_exposure_does_not_matter() -> None:
    moved = np.roll(noise(), SHIFT, axis=1)[None]
    assert alike(np.float32(0.5) * moved + np.float32(0.2))[2, 10, 12] > 0.99


def test_the_two_most_alike_pictures_count() -> None:
    moved, other = np.roll(noise(), SHIFT, axis=1), noise()[::-1]
    both = alike(np.stack([moved, moved]))
    assert_array_equal(alike(np.stack([moved, other, moved]))[2, 5:-5, 5:-9], both[2, 5:-5, 5:-9])


def test_what_no_other_picture_shows_is_unseen() -> None:
    moved = np.roll(noise(), SHIFT, axis=1)[None]
    assert (alike(moved)[2, :, WIDTH - SHIFT :] == UNSEEN).all()
    assert (alike(moved, used=False) == UNSEEN).all()


def test_pixels_without_texture_take_the_plane_of_their_neighbours() -> None:
    costs = np.ones((5, 5, 4), np.float32)
    costs[:, 0, 1] = costs[:, 4, 1] = 0  # the rims know
    costs[2, 2] = 1, 1, 1, 0.9  # noise
    totals = smooth_costs(costs)
    assert (totals.argmin(axis=2) == 1).all()


def test_a_cliff_stays() -> None:
    costs = np.ones((5, 8, 6), np.float32)
    costs[:, :4, 0] = costs[:, 4:, 5] = 0
    assert_array_equal(smooth_costs(costs).argmin(axis=2), np.repeat([[0] * 4 + [5] * 4], 5, axis=0))
