"""Buffers of blosc that lie about their size."""

from __future__ import annotations

from collections.abc import Callable

import blosc
import pytest

from nerfbake.errors import InvalidFile
from nerfbake.formats.wire.blosc import unblosc


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda b: b[:15], "has a blosc buffer of 15 bytes; allowed: 16 or more"),
        (lambda b: b[:-1], r"declares 4,000 bytes packed in \d+; allowed: 4,000 packed in"),
        (lambda b: b[:4] + (1 << 31).to_bytes(4, "little") + b[8:], "declares 2,147,483,648 bytes"),
        (lambda b: b"\xff" + b[1:], "is damaged"),
        (lambda b: b[:16] + b"\xff" * (len(b) - 16), "is damaged"),
    ],
)
def test_a_lying_blosc_buffer_is_refused(change: Callable[[bytes], bytes], said: str) -> None:
    good = blosc.compress(bytes(range(250)) * 16, 4, cname="lz4")
    with pytest.raises(InvalidFile, match=said):
        unblosc(memoryview(change(good)), 4000, "the grid")


def test_a_blosc_buffer_that_declares_too_much_is_not_unpacked() -> None:
    good = blosc.compress(bytes(4000), 4, cname="lz4")
    huge = good[:4] + (1 << 30).to_bytes(4, "little") + good[8:]
    with pytest.raises(InvalidFile, match=r"declares 1,073,741,824 bytes from \d+; allowed: 255 times"):
        unblosc(memoryview(huge), 1 << 30, "the grid")
