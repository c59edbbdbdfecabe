"""Fitting an MLP: its slopes against differences of the error in float64; the same bits by any number of threads."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.lattice import training
from nerfbake.kernels.lattice.training import BATCH, TrainingRows, Weights, train

UNITS, B = 64, 4
ROW = np.arange(BATCH) % 40
WAY = np.arange(BATCH) * 7 % 30


@pytest.fixture(scope="module")
def pairs() -> TrainingRows:
    """Of 40 rows with three features, and 30 directions; some logits are beyond what counts."""
    random = np.random.default_rng(0)
    arrays = ((40, 3), (40, 3 * B), (30, 5), (30, B))
    features, coefficients, code, basis = (random.normal(0, 1, shape).astype(np.float32) for shape in arrays)
    coefficients[::7] *= 20
    return TrainingRows(features, coefficients, code, basis)


def error(pairs: TrainingRows, weights: list[npt.NDArray[np.float64]]) -> float:
    """As the module's docstring has it."""
    first, middle, last, b0, b1, b2 = weights
    x = np.concatenate([pairs.features[ROW], pairs.code[WAY]], axis=1).astype(np.float64)
    logits = np.maximum(np.maximum(x @ first.T + b0, 0) @ middle.T + b1, 0) @ last.T + b2
    own = pairs.coefficients[ROW].reshape(-1, 3, B).astype(np.float64)
    truth = np.clip((own * pairs.basis[WAY][:, None]).sum(axis=2), -10, 10)
    shown, wanted = 1 / (1 + np.exp(-logits)), 1 / (1 + np.exp(-truth))
    return float(((shown - wanted) ** 2 + 1e-3 * (logits - truth) ** 2).sum() / BATCH)


@pytest.mark.parametrize(
    ("number", "place"),
    [(0, (3, 1)), (0, (40, 7)), (1, (63, 5)), (1, (2, 60)), (2, (1, 33)), (3, (17,)), (4, (50,)), (5, (2,))],
)
def test_slopes_are_those_of_the_error(number: int, place: tuple[int, ...], pairs: TrainingRows) -> None:
    weights = training._start(np.random.default_rng(1), 8, UNITS)
    found = training._slopes(pairs, weights, ROW, WAY)
    assert [each.shape for each in found] == [each.shape for each in weights]
    ends = []
    for step in (1e-5, -1e-5):
        moved = [each.astype(np.float64) for each in weights]
        moved[number][place] += step
        ends.append(error(pairs, moved))
    assert_allclose(found[number][place], (ends[0] - ends[1]) / 2e-5, rtol=1e-3, atol=1e-7)


def test_the_error_falls_and_the_bits_hang_on_the_seed_alone(
    pairs: TrainingRows, monkeypatch: pytest.MonkeyPatch
) -> None:
    start = training._start(np.random.default_rng(3), 8, UNITS)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    alone = train(pairs, UNITS, rounds=50, seed=3)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    together, other = train(pairs, UNITS, rounds=50, seed=3), train(pairs, UNITS, rounds=50, seed=4)
    for one, same in zip(alone, together, strict=True):
        assert_array_equal(one, same)
    assert (other.first != together.first).any()
    assert error(pairs, wide(together)) < error(pairs, wide(start)) / 1.4


def wide(weights: Weights) -> list[npt.NDArray[np.float64]]:
    return [each.astype(np.float64) for each in weights]
