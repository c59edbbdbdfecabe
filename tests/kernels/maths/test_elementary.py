"""The elementary functions against x87's 64-bit mantissas, which come out of another unit by other code."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.maths import elementary

RANDOM = np.random.default_rng(5)
pytestmark = pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no numbers longer than float64")


def off(found: npt.NDArray[Any], true: npt.NDArray[Any]) -> float:
    """The largest error in units of the true value's last place."""
    return float((np.abs(found - true) / np.spacing(np.abs(true).astype(np.float64))).max())


def test_exp_and_sigmoid() -> None:
    x = np.concatenate([RANDOM.uniform(-700, 700, 200_000), RANDOM.normal(size=200_000), [0.0, 1.0, -708.0, 709.0]])
    assert off(elementary.exp(x), np.exp(x.astype(np.longdouble))) <= 1
    assert off(elementary.sigmoid(x), 1 / (1 + np.exp(-x.astype(np.longdouble)))) <= 3
    assert elementary.exp([-np.inf, -1e308, 0.0]).tolist() == [0, 0, 1]
    assert np.isfinite(elementary.exp([710.0, np.inf])).all()


def test_expm1_is_exact_near_zero() -> None:
    x = np.concatenate([RANDOM.normal(size=100_000), 10.0 ** RANDOM.uniform(-300, 0, 100_000)])
    assert off(elementary.expm1(x), np.expm1(x.astype(np.longdouble))) <= 64
    assert elementary.expm1(0.0) == 0


def test_log_and_power() -> None:
    x = np.concatenate([10.0 ** RANDOM.uniform(-300, 300, 200_000), RANDOM.uniform(0.5, 2, 200_000), [5e-324]])
    assert off(elementary.log(x), np.log(x.astype(np.longdouble))) <= 2
    assert elementary.log(1.0) == 0
    shades = RANDOM.random(100_000)
    assert off(elementary.power(shades, 2.4), shades.astype(np.longdouble) ** np.longdouble(2.4)) <= 64


def test_sine_and_cosine() -> None:
    x = np.concatenate([RANDOM.uniform(-1e6, 1e6, 100_000), RANDOM.uniform(-7, 7, 100_000), [0.0]])
    sine, cosine = elementary.sine_cosine(x)
    assert np.abs(sine - np.sin(x.astype(np.longdouble))).max() < 3e-16
    assert np.abs(cosine - np.cos(x.astype(np.longdouble))).max() < 3e-16
    assert [float(part) for part in elementary.sine_cosine(0.0)] == [0, 1]


def test_tangent_and_its_inverse() -> None:
    x = np.concatenate([RANDOM.uniform(-1.5, 1.5, 100_000), [0.0]])
    assert off(elementary.tangent(x[:-1]), np.tan(x[:-1].astype(np.longdouble))) < 16
    slopes = np.concatenate([np.tan(x), [np.inf, -np.inf, 1, -1, 1e-300]])
    assert np.abs(elementary.arctan(slopes) - np.arctan(slopes.astype(np.longdouble))).max() < 5e-16


def test_compiled_it_has_the_same_bits() -> None:
    x = RANDOM.normal(0, 100, 10_000)
    s, q = elementary.exp_parts(x)
    np.testing.assert_array_equal([compiled_exp_parts(value) for value in x], np.stack([s, q], axis=1))
