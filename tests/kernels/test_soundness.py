from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from nerfbake.kernels.soundness import all_finite, all_within


def test_every_half_that_is_no_number_is_found() -> None:
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    finite = np.isfinite(halves)
    assert all_finite(halves[finite])
    assert [all_finite(np.array([0, half, -1], np.float16)) for half in halves] == finite.tolist()


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_one_among_many_is_found_wherever_it_stands(dtype: Any) -> None:
    for where in (0, 1 << 18, (1 << 18) + 6):
        values = np.zeros((1 << 18) + 7, dtype)
        values[where] = np.nan
        assert not all_finite(values)


@pytest.mark.parametrize("dtype", [np.float16, np.float32])
def test_a_bound_beyond_the_type_warns_of_nothing(dtype: Any) -> None:
    with np.errstate(all="raise"):
        assert all_within(np.array([-6e4, 6e4], dtype), 1e30)
        assert not all_within(np.array([0, np.inf], dtype), 1e30)
        assert all_within(np.array([-2, 2], dtype), 2)
        assert not all_within(np.array([-2.5, 2], dtype), 2)
