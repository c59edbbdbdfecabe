from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.network.mlp import LANES, pack_layers, run_mlp


def layers(
    rng: np.random.Generator, inputs: int, widths: list[int], skips: tuple[int, ...]
) -> tuple[tuple[Singles, ...], tuple[Singles, ...]]:
    weights, biases, wide = [], [], inputs
    for k, width in enumerate(widths):
        columns = wide + (inputs if k in skips else 0)
        weights.append((rng.normal(size=(width, columns)) / np.sqrt(columns)).astype(np.float32))
        biases.append(rng.normal(size=width).astype(np.float32))
        wide = width
    return tuple(weights), tuple(biases)


def reference(
    weights: tuple[Singles, ...], biases: tuple[Singles, ...], skips: tuple[int, ...], rectified: bool, x: Singles
) -> npt.NDArray[Any]:
    given = h = x.astype(np.float64)
    for k, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
        h = weight.astype(np.float64) @ (np.concatenate([h, given]) if k in skips else h) + bias[:, None]
        if rectified or k + 1 < len(weights):
            h = np.maximum(h, 0)
    return h


def test_one_layer_by_hand() -> None:
    packed = pack_layers((np.array([[1, 2], [3, 4]], np.float32),), (np.array([10, 20], np.float32),), (), False)
    assert_array_equal(run_mlp(packed, np.array([[1, -1], [1, 0]], np.float32), 2), [[13, 9], [27, 17]])


@pytest.mark.parametrize("rectified", [False, True])
@pytest.mark.parametrize(
    ("inputs", "widths", "skips"),
    [(63, [64] * 4 + [65], (2,)), (5, [7, 9, 3], (1, 2)), (1, [1], ()), (4, [2, 1], ())],
)
def test_every_width_and_skip(inputs: int, widths: list[int], skips: tuple[int, ...], rectified: bool) -> None:
    rng = np.random.default_rng(1)
    weights, biases = layers(rng, inputs, widths, skips)
    x = rng.normal(size=(inputs, 3 * LANES + 7)).astype(np.float32)
    found = run_mlp(pack_layers(weights, biases, skips, rectified), x, widths[-1])
    assert_allclose(found, reference(weights, biases, skips, rectified, x), atol=1e-5)


def test_a_point_has_the_same_bits_beside_any_others() -> None:
    rng = np.random.default_rng(2)
    weights, biases = layers(rng, 6, [16, 3], ())
    packed, x = pack_layers(weights, biases, (), False), rng.normal(size=(6, 200)).astype(np.float32)
    alone = np.concatenate([run_mlp(packed, x[:, i : i + 1], 3) for i in range(0, 200, 37)], axis=1)
    assert_array_equal(alone, run_mlp(packed, x, 3)[:, ::37])


def test_no_point_is_no_result() -> None:
    weights, biases = layers(np.random.default_rng(3), 2, [4], ())
    assert run_mlp(pack_layers(weights, biases, (), False), np.empty((2, 0), np.float32), 4).shape == (4, 0)
