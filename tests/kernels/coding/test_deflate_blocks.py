"""The last block of a deflate stream, and streams that follow each other, decompressed by zlib."""

from __future__ import annotations

import zlib

import deflate as libdeflate
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfbake.kernels.coding.deflate_blocks import continued, last_block

STRATEGIES = (zlib.Z_DEFAULT_STRATEGY, zlib.Z_FIXED, zlib.Z_HUFFMAN_ONLY, zlib.Z_RLE)


def inflated(stream: bytes) -> bytes:
    reader = zlib.decompressobj(-15)
    data = reader.decompress(stream)
    assert reader.eof
    assert not reader.unused_data
    return data


def zlib_stream(data: bytes, strategy: int, level: int = 6) -> bytes:
    writer = zlib.compressobj(level, zlib.DEFLATED, -15, 9, strategy)
    return writer.compress(data) + writer.flush()


def test_a_fixed_block_by_hand() -> None:
    # Bits: 1, 1 0 (fixed), 8 of "a" and 7 of the end: 18. A stored block begins at bit 18, its length in byte 3.
    assert zlib_stream(b"a", zlib.Z_FIXED) == b"\x4b\4\0"
    assert bytes(continued(b"\x4b\4\0")) == b"\x4a\4\0\0\0\xff\xff"


def test_a_stored_block_by_hand() -> None:
    # It ends with a byte, so the next block begins in a new one.
    assert bytes(continued(b"\1\1\0\xfe\xffa")) == b"\0\1\0\xfe\xffa\0\0\0\xff\xff"


def test_the_last_of_several_blocks_is_found() -> None:
    writer = zlib.compressobj(6, zlib.DEFLATED, -15)
    first = writer.compress(b"a" * 1000) + writer.flush(zlib.Z_FULL_FLUSH)
    stream = np.frombuffer(first + zlib_stream(b"b", zlib.Z_FIXED) + bytes(16), np.uint8)
    words = stream[: len(stream) // 8 * 8].view("<u8").copy()
    assert last_block(words, 8 * (len(first) + 3)) == (8 * len(first), 8 * len(first) + 18)


@given(st.integers(0, 2**32), st.integers(0, 4000), st.sampled_from([1, 2, 20, 256]), st.sampled_from(STRATEGIES))
def test_a_stream_follows_another(seed: int, size: int, values: int, strategy: int) -> None:
    data = np.random.default_rng(seed).integers(0, values, size).astype(np.uint8).tobytes()
    end = zlib_stream(b"end", 0)
    assert inflated(bytes(continued(zlib_stream(data, strategy))) + end) == data + b"end"
    for level in (0, 1, 5, 12):
        stream = bytes(libdeflate.deflate_compress(data, level))
        assert inflated(bytes(continued(stream)) + end) == data + b"end"


def test_many_blocks_with_long_codes_and_far_matches() -> None:
    # Frequencies that halve give codes of up to 15 bits; repeats of 20,000 bytes give matches of the longest distances.
    rng = np.random.default_rng(0)
    rare = np.minimum(rng.geometric(0.5, 60_000), 255).astype(np.uint8).tobytes()
    data = rare + rng.bytes(20_000) * 2 + bytes(5000) + rare[::-1]
    for stream in (libdeflate.deflate_compress(data, 5), zlib_stream(data, 0, level=9)):
        assert inflated(bytes(continued(stream)) + b"\3\0") == data


@pytest.mark.parametrize("stream", [b"", b"\6", b"\4", b"\5", b"\0\1", b"\1\xff\xff\0\0", b"\x4b\4\0\0", b"\x4b"])
def test_what_is_no_single_stream_is_refused(stream: bytes) -> None:
    with pytest.raises(ValueError, match="deflate stream of"):
        continued(stream)


@given(st.binary(max_size=200))
def test_no_bytes_are_read_or_written_outside(stream: bytes) -> None:
    # With NUMBA_DISABLE_JIT=1, an index outside of an array raises IndexError.
    try:
        found = continued(stream)
    except ValueError:
        return
    assert len(found) in (len(stream) + 4, len(stream) + 5)
