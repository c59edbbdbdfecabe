"""Streams of parts that are compressed at once, decompressed by the standard library, zlib-ng and libdeflate."""

from __future__ import annotations

import gzip
import io
import zipfile
import zlib
from collections.abc import Callable, Iterator

import deflate as libdeflate
import numpy as np
import numpy.typing as npt
import pytest
from zlib_ng import zlib_ng

from nerfbake.formats.wire import deflate
from nerfbake.formats.wire.deflate import deflate_raw, deflate_whole, gzip_whole
from nerfbake.formats.wire.npz import StreamedArray, write_npz

PART = 1 << 12  # here, so that the tests compress little
KINDS: dict[str, Callable[[int], bytes]] = {
    "random": lambda size: np.random.default_rng(0).bytes(size),  # stored blocks
    "zeros": bytes,  # matches alone
    "fixed": lambda size: (bytes(range(256)) * (size // 256 + 1))[:size],  # fixed blocks: one match for 258 bytes
    "text": lambda size: b" ".join(str(k).encode() for k in range(size))[:size],  # dynamic blocks
    "mixed": lambda size: (np.random.default_rng(0).bytes(PART + 7) + bytes(PART - 3) + b"abc" * size)[:size],
}
SIZES = (2 * PART, 2 * PART + 1, 3 * PART - 1, 3 * PART, 5 * PART + 77)


class Rows:
    """The rows of an array, which are not in memory as a whole."""

    def __init__(self, array: npt.NDArray[np.float16]) -> None:
        self._array, self.shape, self.dtype = array, array.shape, array.dtype

    def __getitem__(self, rows: slice, /) -> npt.NDArray[np.float16]:
        return self._array[rows].copy()


@pytest.fixture
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(deflate, "_PART", PART)
    monkeypatch.setattr(deflate, "_PARTS", 2)


def raw(data: bytes) -> bytes:
    return b"".join(deflate_raw(b"head", [data]))


@pytest.mark.usefixtures("small_parts")
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("kind", KINDS)
def test_every_reader_reads_one_stream(kind: str, size: int) -> None:
    data = KINDS[kind](size)
    whole = deflate_whole([data])
    assert whole != libdeflate.zlib_compress(data, deflate.WHOLE_LEVEL)  # it is made of parts
    reader = zlib.decompressobj()
    assert reader.decompress(whole) == data
    assert reader.eof
    assert not reader.unused_data
    assert zlib_ng.decompress(whole) == data == libdeflate.zlib_decompress(whole, size)
    packed = gzip_whole([data])
    assert gzip.decompress(packed) == zlib_ng.decompress(packed, 31) == data == libdeflate.gzip_decompress(packed, size)
    assert zlib.decompress(raw(data), -15) == b"head" + data == libdeflate.deflate_decompress(raw(data), size + 4)


@pytest.mark.parametrize("size", [0, 1, 1000, 100_000])
@pytest.mark.parametrize("kind", KINDS)
def test_less_than_a_part_has_the_bytes_of_libdeflate(kind: str, size: int) -> None:
    data = KINDS[kind](size)
    assert deflate_whole([data[:7], data[7:]]) == libdeflate.zlib_compress(data, deflate.WHOLE_LEVEL)
    assert gzip_whole([data[:7], data[7:]]) == libdeflate.gzip_compress(data, deflate.WHOLE_LEVEL)
    assert raw(data)[9:] == libdeflate.deflate_compress(data, deflate.WHOLE_LEVEL)


@pytest.mark.usefixtures("small_parts")
def test_the_bytes_depend_neither_on_threads_nor_on_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    data = KINDS["mixed"](9 * PART + 5)
    found = set()
    for threads in ("1", "2", "5"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        for step in (len(data), 3 * PART, PART, PART - 1, 700):
            pieces = [memoryview(data)[at : at + step] for at in range(0, len(data), step)]
            found.add((deflate_whole([b"", *pieces, b""]), gzip_whole(pieces), b"".join(deflate_raw(b"", pieces))))
    assert len(found) == 1


@pytest.mark.usefixtures("small_parts")
def test_an_error_of_the_pieces_ends_the_stream() -> None:
    def pieces() -> Iterator[bytes]:
        yield bytes(4 * PART)
        raise OSError("disk")

    with pytest.raises(OSError, match="disk"):
        deflate_whole(pieces())


def test_a_large_array_is_read_by_numpy_and_hardly_larger() -> None:
    # 17 MB: 16 parts of the real size, and one that is not full.
    rows = np.resize(np.random.default_rng(0).normal(size=(1 << 15, 17)).astype(np.float16), (500_000, 17))
    packed = b"".join(write_npz({"rows": StreamedArray(Rows(rows))}, deflated=True))
    with np.load(io.BytesIO(packed)) as archive:
        assert np.array_equal(archive["rows"], rows)
    assert zipfile.ZipFile(io.BytesIO(packed)).testzip() is None
    whole = libdeflate.deflate_compress(rows.tobytes(), deflate.WHOLE_LEVEL)
    assert len(whole) < len(packed) < 1.002 * len(whole)
