from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile
from nerfbake.kernels.coding.varint import decode_varints, encode_varints, varint_sizes

numbers = st.one_of(st.integers(-(2**31), 2**31 - 1), st.integers(-2, 300), st.sampled_from([127, 128, 16383, 16384]))


def one(value: int) -> bytes:
    """The definition: 7 bits a byte, low bits first, the top bit set while more follow; negative as 64 bits."""
    value &= (1 << 64) - 1
    out = bytearray()
    while True:
        out.append(value & 0x7F | (0x80 if value > 0x7F else 0))
        value >>= 7
        if not value:
            return bytes(out)


@given(arrays(np.int32, st.integers(0, 40), elements=numbers))
def test_varints_are_what_the_definition_says(values: npt.NDArray[np.int32]) -> None:
    expected = b"".join(one(int(value)) for value in values)
    assert encode_varints(values) == expected
    assert varint_sizes(values) == len(expected)
    assert_array_equal(decode_varints(np.frombuffer(expected, np.uint8)), values)


def test_numbers_cut_in_two_by_a_chunk_are_read(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.random.default_rng(0).integers(-5, 2**31, 500).astype(np.int32)
    data = np.frombuffer(encode_varints(values), np.uint8)
    for chunk in (10, 11, 64, 1000):
        monkeypatch.setattr("nerfbake.kernels.coding.varint._CHUNK", chunk)
        assert_array_equal(decode_varints(data), values)


def test_longer_spellings_of_a_number_are_read() -> None:
    # Two bytes for 0, and a 64-bit number of which an int32 keeps the low bits.
    assert_array_equal(decode_varints(np.frombuffer(b"\x80\x00" + one(2**40 + 7), np.uint8)), [0, 7])


@pytest.mark.parametrize("data", [b"\x80", b"\x01\xff\xff", b"\x80" * 10 + b"\x00"])
def test_a_number_that_does_not_end_is_refused(data: bytes) -> None:
    with pytest.raises(InvalidFile, match="does not end"):
        decode_varints(np.frombuffer(data, np.uint8))
