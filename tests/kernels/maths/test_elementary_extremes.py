from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from nerfbake.kernels.maths import elementary as module
from nerfbake.kernels.maths.elementary import extremes


def test_by_hand() -> None:
    values = np.array([[1, np.nan, 5], [-2, np.inf, 6], [9, -np.inf, 7]], np.float16)
    found = extremes(values, np.array([True, True, False]))
    assert found.range() == [-2, 6]
    assert found.range(slice(0, 1)) == [-2, 1]
    assert found.range(slice(1, 2)) is None
    assert found.range(slice(3, 3)) is None
    assert found.non_finite == 2
    assert extremes(values).range(slice(2, 3)) == [5, 7]
    assert extremes(values[:0]).range() is None


@pytest.mark.parametrize("dtype", [np.float16, np.float32, np.float64])
def test_chunks_do_not_show(dtype: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    random = np.random.default_rng(0)
    values = random.normal(size=(1000, 7)).astype(dtype)
    values[random.random(values.shape) < 0.1] = np.nan
    which = random.random(1000) < 0.5
    whole = extremes(values, which)
    monkeypatch.setattr(module, "_CHUNK", 50)
    for a, b in zip(whole, extremes(values, which), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(whole.low, np.nanmin(values[which], axis=0))
    assert whole.non_finite == np.isnan(values[which]).sum()
