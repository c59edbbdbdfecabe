"""Colours cut at 0 as the sigmoid of sums: against NumPy's least squares, and the logarithm that both hang on."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from nerfbake.kernels.lattice.harmonics import LEAST, evaluate_colours, inverse_of, log_lanes, refit_coefficients
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import fibonacci

RANDOM = np.random.default_rng(3)


def test_coefficients_are_the_least_squares_of_the_logits() -> None:
    directions = fibonacci(64)
    basis, wanted = sh_basis(directions, 9), sh_basis(directions, 16)
    features = RANDOM.normal(0, 0.7, (70, 27)).astype(np.float32)  # more than a block of lanes; some colours are cut
    colours = 0.5 + features.reshape(-1, 9) @ basis.T
    assert colours.min() < 0
    assert colours.max() > 1
    cut = np.clip(colours, LEAST, 1 - LEAST)
    expected = np.linalg.lstsq(wanted, np.log(cut / (1 - cut)).T, rcond=None)[0].T.reshape(70, 48)
    found = refit_coefficients(features, basis.astype(np.float32), inverse_of(wanted))
    assert_allclose(found, expected, rtol=1e-5, atol=1e-4)


def test_a_colour_is_seen_in_its_own_direction() -> None:
    directions, features = fibonacci(5), RANDOM.normal(0, 0.5, (8, 12)).astype(np.float32)
    ray = np.array([4, 0, 1, 1, 2, 3, 4, 0])
    expected = np.maximum(0.5 + np.einsum("kcb,kb->kc", features.reshape(8, 3, 4), sh_basis(directions[ray], 4)), 0)
    assert_allclose(evaluate_colours(features, sh_basis(directions, 4, np.float32), ray), expected, atol=1e-6)


def test_the_logarithm_of_lanes() -> None:
    x = np.exp(np.linspace(-80, 80, 4001)).astype(np.float32)
    found = x.copy()
    log_lanes(found, np.empty(len(x), np.int32))
    assert_allclose(found, np.log(x.astype(np.float64)), rtol=3e-7, atol=2e-7)
