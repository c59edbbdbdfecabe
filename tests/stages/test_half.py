from __future__ import annotations

import numpy as np
import pytest

from nerfbake.errors import InvalidScene
from nerfbake.stages import half
from nerfbake.stages.half import cast_values


@pytest.fixture(autouse=True)
def small_chunks(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(half, "_CHUNK", 8)


@pytest.mark.parametrize("dtype", ["f2", "f4", "f8"])
@pytest.mark.parametrize("shape", [(0, 3), (1, 3), (100, 3), (50,)])
def test_values_are_those_of_numpy(dtype: str, shape: tuple[int, ...]) -> None:
    values = np.random.default_rng(0).normal(0, 100, shape).astype(np.float32)
    values[1:2] = np.nan
    cast = cast_values(values, np.dtype(dtype), what="the tree", asked="float16")
    assert cast.dtype == dtype
    np.testing.assert_array_equal(cast, values.astype(dtype))


def test_values_that_have_the_type_are_not_copied() -> None:
    values = np.zeros((3, 4), np.float32)
    assert cast_values(values, np.dtype(np.float32), what="the tree", asked="float16") is values


def test_the_largest_value_is_named() -> None:
    values = np.zeros((100, 3), np.float32)
    values[20], values[70], values[90] = 7e4, -8e4, np.nan
    with pytest.raises(InvalidScene, match="the tree holds 80000; allowed: up to 65504 for float16"):
        cast_values(values, np.dtype(np.float16), what="the tree", asked="float16")
