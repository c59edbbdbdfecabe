"""Covariances and axes of splats are the same thing, and a pair is replaced by what looks like it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake.kernels.splat.merging import Mixture, choose_pairs, fill_axes, fill_forms, find_partners, merge_pairs
from tests.support.splats import splats


def forms(scales: np.ndarray, quats: np.ndarray) -> np.ndarray:
    form = np.empty((len(scales), 6))
    fill_forms(scales, quats, form)
    return form


def test_axes_have_the_covariance_that_they_came_from() -> None:
    scene = splats(200, seed=4)
    form = forms(scene.scales, scene.quats)
    sizes, turns = np.empty_like(scene.scales), np.empty_like(scene.quats)
    fill_axes(form, sizes, turns)
    largest = form[:, [0, 3, 5]].max(axis=1, keepdims=True)
    assert (np.abs(forms(sizes, turns) - form) <= 1e-5 * largest).all()
    assert_allclose((turns.astype(np.float64) ** 2).sum(axis=1), 1, atol=1e-6)
    assert_allclose(np.sort(sizes, axis=1), np.sort(scene.scales, axis=1), rtol=1e-3, atol=1e-6)


def mixture(places: list[float], colours: list[float], opacity: float) -> Mixture:
    """Round splats of standard deviation 1 on the x axis, grey."""
    n = len(places)
    form = np.tile(np.array([1.0, 0, 0, 1, 0, 1]), (n, 1))
    centre = np.array([[x, 0.0, 0.0] for x in places])
    colour = np.array([[grey] * 3 for grey in colours])
    return Mixture(centre, form, np.full(n, opacity), colour, np.arange(n))


def test_a_union_by_hand() -> None:
    # Along x, light is 2 pi (0.2 + 0.2 - 0.2^2 / 2): the centres lie behind each other. Along y and z, the product of
    # the two is e^(-4 / 4) / 2 of a splat. The union is sqrt(1 + 1) as wide along x, so its light is 1 + 2 sqrt(2).
    pair = mixture([-1, 1], [0.25, 0.75], 0.2)
    sh = np.array([[[-1.0] * 3], [[1.0] * 3]], np.float32)
    merge_pairs(pair, sh, np.array([[0, 1]], np.int32), 0.0)
    shared = 0.5 + 2 * 0.5 * np.exp(-1)
    assert_allclose(pair.centre[0], 0, atol=1e-12)
    assert_allclose(pair.form[0], [2, 0, 0, 1, 0, 1], atol=1e-12)
    assert pair.opacity[0] == pytest.approx((3 * 0.4 - 0.04 * shared) / (1 + 2 * np.sqrt(2)))
    assert_allclose(pair.colour[0], 0.5)
    assert_allclose(sh[0], 0, atol=1e-7)


def test_the_partner_is_near_and_has_the_same_colour() -> None:
    # 0 and 1 are as near as 1 and 2, but only 1 and 2 have the same colour; 3 is farther away.
    some = mixture([0, 1, 2, 3.5], [0.2, 0.7, 0.7, 0.7], 0.5)
    partners, errors = np.empty(4, np.int32), np.empty(4)
    find_partners(some, 0.0, 3, partners, errors)
    assert partners.tolist() == [1, 2, 1, 2]
    assert errors[1] == errors[2] < errors[0]
    taken, pairs = np.zeros(4, np.bool_), np.empty((2, 2), np.int32)
    assert choose_pairs(np.argsort(errors, kind="stable"), partners, taken, pairs) == 1
    assert pairs[0].tolist() == [1, 2]
    assert taken.tolist() == [False, True, True, False]


def test_flat_and_transparent_splats_have_a_union() -> None:
    some = mixture([0, 1], [0.2, 0.7], 0.0)
    some.form[:] = 0
    sh = np.zeros((2, 1, 3), np.float32)
    merge_pairs(some, sh, np.array([[0, 1]], np.int32), 1e-60)
    assert np.isfinite(some.form).all()
    assert some.opacity[0] == 0
