from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.vdb import bitmask
from nerfbake.kernels.vdb.bitmask import in_order_of, reduce_runs, rows_of_runs, spread_of, spread_over


def test_empty_runs_say_so() -> None:
    rows = np.array([4.0, 2, 9, 7])
    assert_array_equal(reduce_runs(np.minimum, rows, np.array([0, 3, 0, 1, 0]), 99), [99, 2, 99, 7, 99])
    assert_array_equal(reduce_runs(np.add, rows[:0], np.array([0, 0]), 0), [0, 0])


def test_runs_in_another_order() -> None:
    assert_array_equal(rows_of_runs(np.array([2, 1, 0, 3]), np.array([3, 1, 2, 0])), [3, 4, 5, 2, 0, 1])


@pytest.mark.parametrize("at_once", [1, 2, 1024])
def test_values_of_runs_in_another_order(at_once: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bitmask, "_RUNS", at_once)
    counts, order = np.array([2, 1, 0, 3]), np.array([3, 2, 0])
    assert_array_equal(in_order_of(np.arange(10, 16), counts, order), [13, 14, 15, 10, 11])


def test_the_spread_of_spreads_is_the_spread_of_all() -> None:
    values = np.random.default_rng(0).normal(5, 3, 60).astype(np.float32)
    whole = spread_of(values, np.array([60]))
    parts = spread_over(spread_of(values, np.array([7, 0, 50, 3])), np.array([4]))
    for spread in (whole, parts):
        assert (spread.size[0], spread.low[0], spread.high[0]) == (60, values.min(), values.max())
        assert_allclose(spread.mean, values.mean(dtype=np.float64))
        assert_allclose(spread.deviation, values.std(dtype=np.float64))
