from __future__ import annotations

import bson
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfbake.kernels.coding.bson import fill_numbers, scan_numbers


def body_of(numbers: list[float]) -> np.ndarray[tuple[int], np.dtype[np.uint8]]:
    return np.frombuffer(bson.encode({str(i): number for i, number in enumerate(numbers)})[4:-1], np.uint8)


@settings(max_examples=50)
@given(
    st.lists(
        st.integers(-(2**31), 2**31 - 1) | st.integers(-(2**63), 2**63 - 1).map(bson.Int64) | st.floats(allow_nan=False)
    )
)
def test_numbers_are_those_that_pymongo_wrote(numbers: list[float]) -> None:
    body = body_of(numbers)
    real = sum(isinstance(number, float) for number in numbers)
    assert scan_numbers(body) == (len(numbers), real)
    whole = np.empty(len(numbers), np.int64)
    fill_numbers(body, real > 0, whole, whole.view(np.float64))
    assert (whole.view(np.float64) if real else whole).tolist() == [float(n) if real else n for n in numbers]


@pytest.mark.parametrize("cut", range(1, 24))
def test_numbers_that_are_cut_off_are_not_counted(cut: int) -> None:
    body = body_of([1, 2.5])  # 7 bytes, then 11
    assert scan_numbers(body[:cut])[0] == {7: 1, 18: 2}.get(min(cut, 18), -1)
