"""Read and write NumPy's .npz archives.

The writer produces the same bytes for the same arrays on every machine. Members are dated 1980, and stored or, like
those of np.savez_compressed, deflated. Stored members start at multiples of 64 bytes, so that a reader can map them:

    local header 30 B | name | extra: [zip64 20 B] + padding | .npy header and data
    ... | central directory | [zip64 end records] | end record 22 B

The local headers contain the sizes and CRCs, because cnpy, the reader of volrend, does not look for them after the
data.

The reader accepts untrusted files and never unpickles. zip_reader.py describes its checks. A member is inflated in one
call into the memory of its array: libdeflate takes half the time of zlib and makes no intermediate copy.
"""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from math import prod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from zlib_ng import zlib_ng

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.blob import RowSource, row_pieces
from nerfbake.formats.wire.deflate import deflate_raw
from nerfbake.formats.wire.npy import npy_head, npy_pieces, read_header
from nerfbake.formats.wire.zip_reader import (
    ZipReader,
)
from nerfbake.kernels.maths.elementary import cast


class NpzReader:
    """The arrays of an archive, each read on demand."""

    def __init__(self, view: memoryview) -> None:
        self._zip = ZipReader(view, "an .npz as NumPy writes it")
        members = self._zip.members
        self._members = {name.removesuffix(".npy"): info for name, info in members.items()}
        if len(self._members) != len(members):
            raise InvalidFile(Problem("zip directory", "lists a name twice", "each name once"))

    @property
    def names(self) -> list[str]:
        """The names of all members, in the order of the archive."""
        return list(self._members)

    def __contains__(self, key: str) -> bool:
        return key in self._members

    def require(self, *keys: str) -> None:
        """Raise InvalidFile with the names of all missing keys."""
        if missing := [key for key in keys if key not in self]:
            there = ", ".join(sorted(self._members)[:20]) or "nothing"
            raise InvalidFile(Problem("npz", f"has no {', '.join(missing)}", f"{', '.join(keys)} (it holds {there})"))

    def scalar(self, key: str) -> Any:
        """The single value of a member, as a Python object."""
        array = self.array(key, limit=1 << 16)
        if array.size != 1:
            raise InvalidFile(Problem(key, f"has shape {array.shape}", "one value"))
        return array.item()

    def array(self, key: str, *, limit: int | None = None) -> npt.NDArray[Any]:
        """A member as an array of native byte order; read-only if it is a view of the file."""
        self.require(key)
        return self._read(key, self._members[key], limit)

    def shaped(self, key: str, kinds: str, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
        """A member with a dtype of one of these kinds (NumPy's letters) and this shape; None stands for any length."""
        array = self.array(key)
        fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
        if array.dtype.kind not in kinds or not fits:
            allowed = f"({', '.join('any' if edge is None else str(edge) for edge in shape)}) of kind {kinds}"
            raise InvalidFile(Problem(key, f"has dtype {array.dtype}, shape {array.shape}", allowed))
        return array

    def single(self, key: str) -> npt.NDArray[np.float32]:
        """A member of floats as float32; values beyond float32 become infinite."""
        array = self.array(key)
        if array.dtype.kind != "f":
            raise InvalidFile(Problem(key, f"has dtype {array.dtype}", "float16, float32 or float64"))
        memory.hold(key, 4 * array.size)
        return cast(array, np.float32)

    def _read(self, key: str, info: zipfile.ZipInfo, limit: int | None) -> npt.NDArray[Any]:
        if limit is not None and info.file_size > limit:
            raise InvalidFile(Problem(key, f"has {info.file_size:,} bytes", f"{limit:,} at most"))
        raw = self._zip.unpacked(info.filename, key)
        stream = _Bytes(key, raw)
        shape, fortran, dtype = read_header(key, stream)
        size = dtype.itemsize * prod(shape)
        if stream.taken + size != len(raw):
            found = f"declares shape {shape} {dtype}, {stream.taken + size:,} bytes"
            raise InvalidFile(Problem(key, found, f"{len(raw):,} bytes, as in the zip directory"))
        array = np.frombuffer(raw[stream.taken :], dtype) if size else np.empty(0, dtype)
        array = array.reshape(shape[::-1]).T if fortran else array.reshape(shape)
        if dtype.isnative:
            return _sound_text(key, array)
        memory.hold(key, size)
        return _sound_text(key, array.astype(dtype.newbyteorder("=")))


def _sound_text(key: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return the array. Raises InvalidFile for text that is not Unicode: its Python strings would fail later."""
    if array.dtype.kind == "U":
        points = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
        if ((points > 0x10FFFF) | ((points >= 0xD800) & (points < 0xE000))).any():
            raise InvalidFile(Problem(key, "has text that is not Unicode", "Unicode"))
    return array


class _Bytes:
    """A stream of a member's bytes."""

    def __init__(self, key: str, raw: memoryview) -> None:
        self._key, self._raw, self.taken = key, raw, 0

    def read(self, size: int) -> bytes:
        """Return exactly `size` bytes. Raises InvalidFile if there are fewer."""
        piece = bytes(self._raw[self.taken : self.taken + size])
        if len(piece) < size:
            raise InvalidFile(Problem(self._key, f"ends after {len(self._raw):,} bytes", "an array (.npy)"))
        self.taken += size
        return piece


ALIGN = 64
_ZIP64_FROM = 0xFFFFFFFF  # numbers from here on need the zip64 field
_NO_SIZE = 0xFFFFFFFF  # value of a 32-bit field if the number is in the zip64 field
_DEFLATED = 8
_DATE_1980 = 0x0021  # 1 January 1980 as a DOS date
_UNIX, _MODE = 3 << 8, 0o100644 << 16


class StreamedArray(NamedTuple):
    """An array that is not in memory as a whole. Its rows are computed twice, because the CRC precedes them."""

    rows: RowSource


def write_npz(
    arrays: Mapping[str, npt.ArrayLike | StreamedArray], *, deflated: bool = False
) -> Iterator[bytes | memoryview]:
    """Yield the archive in pieces; stored arrays are not copied."""
    directory, at = [], 0
    for key, value in arrays.items():
        name = f"{key}.npy".encode()
        head, size, pieces = _member(value)
        crc = zlib_ng.crc32(head)
        for piece in pieces():
            crc = zlib_ng.crc32(piece, crc)
        body = deflate_raw(head, pieces()) if deflated else None
        packed = size if body is None else sum(map(len, body))
        zip64 = struct.pack("<HHQQ", 1, 16, size, packed) if max(size, packed) >= _ZIP64_FROM else b""
        version = 45 if zip64 else 20
        unpadded = at + 30 + len(name) + len(zip64) + 4
        padding = -unpadded % ALIGN
        extra = zip64 + struct.pack("<HH", 0xD935, padding) + bytes(padding)
        method = _DEFLATED if deflated else 0
        fields = (_NO_SIZE, _NO_SIZE) if zip64 else (packed, size)
        common = (0, method, 0, _DATE_1980, crc, *fields, len(name))
        yield struct.pack("<4s5H3I2H", b"PK\3\4", version, *common, len(extra)) + name + extra
        if body is None:
            yield head
            yield from pieces()
        else:
            yield from body
        directory.append(_central(name, version, common, (size, packed), at))
        at += 30 + len(name) + len(extra) + packed
    entries = b"".join(directory)
    yield entries + _end(len(directory), len(entries), at)


def _member(value: npt.ArrayLike | StreamedArray) -> tuple[bytes, int, Callable[[], Iterable[memoryview]]]:
    """Return an array's header, its size with the header, and a function that returns the pieces of its data."""
    if isinstance(value, StreamedArray):
        rows = value.rows
        head = npy_head(rows.shape, rows.dtype)
        return head, len(head) + prod(rows.shape) * rows.dtype.itemsize, lambda: row_pieces(rows)
    head, body = npy_pieces(np.asarray(value))
    return head, len(head) + len(body), lambda: (body,)


def _central(name: bytes, version: int, common: tuple[int, ...], sizes: tuple[int, int], at: int) -> bytes:
    zip64 = b""
    if max(sizes) >= _ZIP64_FROM:
        zip64 += struct.pack("<QQ", *sizes)
    if at >= _ZIP64_FROM:
        zip64 += struct.pack("<Q", at)
    extra = struct.pack("<HH", 1, len(zip64)) + zip64 if zip64 else b""
    made_by = _UNIX | 45
    entry = struct.pack("<4s6H3I2H", b"PK\1\2", made_by, version, *common, len(extra))
    return entry + struct.pack("<3H2I", 0, 0, 0, _MODE, _u32(at)) + name + extra


def _end(count: int, size: int, at: int) -> bytes:
    zip64 = b""
    if at >= _ZIP64_FROM:
        zip64 = struct.pack("<4sQ2H2I4Q", b"PK\6\6", 44, 45, 45, 0, 0, count, count, size, at)
        zip64 += struct.pack("<4sIQI", b"PK\6\7", 0, at + size, 1)
    return zip64 + struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, count, count, size, _u32(at), 0)


def _u32(number: int) -> int:
    return number if number < _ZIP64_FROM else _NO_SIZE
