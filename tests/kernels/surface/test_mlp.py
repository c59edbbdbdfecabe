"""The MLP, fast and exact, against the formula."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.surface import mlp

RANDOM = np.random.default_rng(3)


def by_formula(features: np.ndarray, directions: np.ndarray, w0: np.ndarray, w1: np.ndarray) -> np.ndarray:
    """(m, 3, n), pair by pair in float64."""
    m, n = len(features), len(directions)
    inputs = np.concatenate([np.tile(directions, (m, 1)), np.repeat(features, n, axis=0)], axis=1)
    outputs = 1 / (1 + np.exp(-np.maximum(inputs @ w0.astype(float), 0) @ w1.astype(float)))
    return np.asarray(outputs.reshape(m, n, 3).transpose(0, 2, 1))


@pytest.mark.parametrize("hidden", [1, 7, 32])
def test_outputs_are_the_formula(hidden: int) -> None:
    w0, w1 = RANDOM.normal(size=(6, hidden)).astype("f4"), RANDOM.normal(size=(hidden, 3)).astype("f4")
    features, directions = RANDOM.random((9, 3)), fibonacci(11)
    expected = by_formula(features, directions, w0, w1)
    assert np.abs(mlp.evaluate(features, directions, w0, w1) - expected).max() < 1e-6


def test_saturated_outputs_stay_finite() -> None:
    w0, w1 = np.full((6, 1), 1e5, np.float32), np.array([[1e5, -1e5, 0]], np.float32)
    shown = mlp.evaluate(np.ones((1, 3)), np.array([[0.0, 1.0, 0.0]]), w0, w1)
    np.testing.assert_allclose(shown[0, :, 0], [1, 0, 0.5], atol=1e-30)


def test_projection_is_a_product() -> None:
    w0, w1 = RANDOM.normal(size=(6, 8)).astype("f4"), RANDOM.normal(size=(8, 3)).astype("f4")
    features, directions = RANDOM.random((20, 3)), fibonacci(7)  # 21 outputs: not a multiple of 4
    basis, shift = RANDOM.normal(size=(21, 5)).astype("f4"), RANDOM.normal(size=5).astype("f4")
    expected = mlp.evaluate(features, directions, w0, w1).reshape(20, 21) @ basis - shift
    np.testing.assert_allclose(
        mlp.project(features, mlp.split_layers(directions, w0, w1), basis, shift), expected, atol=1e-4
    )


def test_comparison_by_hand() -> None:
    # Weights of zero show 1/2 everywhere: 127.5, which rounds to 128 and is cut to 127.
    w0, w1 = np.zeros((6, 4), np.float32), np.zeros((4, 3), np.float32)
    table = np.array([[125, 125, 125]], np.float32) / np.float32(255)
    shown = mlp.AtlasWeights(table, np.zeros((1, 1), np.int32), np.ones((1, 1), np.float32))
    one, direction = np.zeros((1, 3)), np.array([[0.0, 1.0, 0.0]])
    np.testing.assert_allclose(
        mlp.differences(one, mlp.split_layers(direction, w0, w1), shown), [[9, 27, 7.5, 18.75]], rtol=1e-4
    )
    np.testing.assert_allclose(mlp.exact_differences(one, direction, w0, w1, shown), [[6, 12, 7.5, 18.75]], rtol=1e-4)
