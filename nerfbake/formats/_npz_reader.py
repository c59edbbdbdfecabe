"""NumPy's .npz archives, read as if a stranger had sent them.

Nothing is unpickled; sizes are settled from the headers before anything is allocated; a deflated member is
inflated straight into its array, which is never larger than declared; CRCs are checked; stored members become
views of the file.
"""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt
from zlib_ng import zlib_ng

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats._npy import read_header

ZIP_MAGIC = (b"PK\x03\x04", b"PK\x05\x06")
MAX_INFLATION = 1032  # deflate's own bound: 258 bytes for a quarter of a byte
MAX_MEMBERS = 1000
_CHUNK = 1 << 18


class NpzReader:
    """The arrays of an archive, each read when it is asked for."""

    def __init__(self, view: memoryview) -> None:
        self._view = view
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # duplicate names are ours to refuse
                members = zipfile.ZipFile(_ViewFile(view)).infolist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError, EOFError, OSError, struct.error) as error:
            raise InvalidFile(f"is no whole zip archive ({error}); allowed: an .npz as NumPy writes it") from None
        if len(members) > MAX_MEMBERS:
            raise InvalidFile(Problem("zip directory", f"lists {len(members):,} members", f"{MAX_MEMBERS} at most"))
        self._members = {info.filename.removesuffix(".npy"): info for info in members}
        if len(self._members) != len(members):
            raise InvalidFile(Problem("zip directory", "lists a name twice", "each name once"))

    def __contains__(self, key: str) -> bool:
        return key in self._members

    def require(self, *keys: str) -> None:
        """Raises InvalidFile naming every key that is missing."""
        if missing := [key for key in keys if key not in self]:
            there = ", ".join(sorted(self._members)[:20]) or "nothing"
            raise InvalidFile(Problem("npz", f"has no {', '.join(missing)}", f"{', '.join(keys)} (it holds {there})"))

    def scalar(self, key: str) -> Any:
        """The one value of a member, as a Python object."""
        array = self.array(key, limit=1 << 16)
        if array.size != 1:
            raise InvalidFile(Problem(key, f"has shape {array.shape}", "one value"))
        return array.item()

    def array(self, key: str, *, limit: int | None = None) -> npt.NDArray[Any]:
        """A member as an array of native byte order, read-only where it views the file."""
        self.require(key)
        info = self._members[key]
        try:
            return self._read(key, info, limit)
        except zlib_ng.error as error:  # type: ignore[misc]  # an exception, though its stub does not say so
            raise InvalidFile(
                f"{key}: the deflated data are damaged ({error}); allowed: a whole deflate stream"
            ) from None

    def shaped(self, key: str, kinds: str, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
        """A member whose dtype is one of these kinds (NumPy's letters) and whose shape is this, None for any edge."""
        array = self.array(key)
        fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
        if array.dtype.kind not in kinds or not fits:
            allowed = f"({', '.join('any' if edge is None else str(edge) for edge in shape)}) of kind {kinds}"
            raise InvalidFile(Problem(key, f"has dtype {array.dtype}, shape {array.shape}", allowed))
        return array

    def _read(self, key: str, info: zipfile.ZipInfo, limit: int | None) -> npt.NDArray[Any]:
        packed = self._packed(key, info)
        stream = _Inflater(key, packed, info)
        shape, fortran, dtype = read_header(key, stream)
        size = dtype.itemsize
        for edge in shape:  # Python's integers do not overflow
            size *= edge
        if stream.taken + size != info.file_size:
            found = f"declares shape {shape} {dtype}, {stream.taken + size:,} bytes"
            raise InvalidFile(Problem(key, found, f"{info.file_size:,} bytes as the zip directory says"))
        if limit is not None and size > limit:
            raise InvalidFile(Problem(key, f"has {size:,} bytes", f"{limit:,} at most"))
        if info.compress_type == zipfile.ZIP_STORED:
            raw = np.frombuffer(packed[stream.taken :], np.uint8)
            if zlib_ng.crc32(packed) != info.CRC:
                raise InvalidFile(Problem(key, "has a wrong CRC-32", f"{info.CRC:08x}"))
        else:
            memory.hold(key, size)
            raw = np.empty(size, np.uint8)
            stream.read_into(raw.data)
            stream.finish()
        array = raw.view(dtype) if size else np.empty(0, dtype)
        array = array.reshape(shape[::-1]).T if fortran else array.reshape(shape)
        return array.astype(dtype.newbyteorder("="), copy=False)

    def _packed(self, key: str, info: zipfile.ZipInfo) -> memoryview:
        """The member's bytes in the file, as the directory and its local header agree on them."""
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & 1:
            raise InvalidFile(
                Problem(key, f"uses zip method {info.compress_type}", "stored or deflated, not encrypted")
            )
        head = bytes(self._view[info.header_offset : info.header_offset + 30])
        if len(head) < 30 or head[:4] != ZIP_MAGIC[0]:
            raise InvalidFile(Problem(key, f"has no local header at byte {info.header_offset:,}", "PK 03 04 there"))
        name_size, extra_size = struct.unpack("<HH", head[26:])
        start = info.header_offset + 30 + name_size + extra_size
        packed = self._view[start : start + info.compress_size]
        if len(packed) < info.compress_size:
            raise InvalidFile(Problem(key, f"ends after {len(packed):,} bytes", f"{info.compress_size:,}"))
        if info.compress_type == zipfile.ZIP_STORED and info.compress_size != info.file_size:
            raise InvalidFile(Problem(key, f"is stored as {info.compress_size:,} bytes", f"{info.file_size:,}"))
        if info.file_size > MAX_INFLATION * info.compress_size + 64:
            found = f"declares {info.file_size:,} bytes from {info.compress_size:,}"
            raise InvalidFile(Problem(key, found, f"{MAX_INFLATION} times as many, deflate's bound"))
        return packed


class _ViewFile(io.RawIOBase):
    """A memoryview as the seekable file that zipfile wants, without a copy of it."""

    def __init__(self, view: memoryview) -> None:
        self._view, self._at = view, 0

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        self._at = max(0, offset + (0, self._at, len(self._view))[whence])
        return self._at

    def tell(self) -> int:
        return self._at

    def read(self, size: int | None = -1) -> bytes:
        end = len(self._view) if size is None or size < 0 else self._at + size
        piece = bytes(self._view[self._at : end])
        self._at += len(piece)
        return piece


class _Inflater:
    """The bytes of a member in order, stored or deflated, with its CRC kept on the way."""

    def __init__(self, key: str, packed: memoryview, info: zipfile.ZipInfo) -> None:
        self._key, self._packed, self._info = key, packed, info
        self._inflate = (
            zlib_ng.decompressobj(-zlib_ng.MAX_WBITS) if info.compress_type == zipfile.ZIP_DEFLATED else None
        )
        self._at = 0  # bytes of `packed` given to the inflater, or read
        self._crc = 0
        self.taken = 0

    def read(self, size: int) -> bytes:
        """Exactly `size` bytes."""
        buffer = bytearray(size)
        self.read_into(memoryview(buffer))
        return bytes(buffer)

    def read_into(self, out: memoryview) -> None:
        filled = 0
        while filled < len(out):
            piece = self._next(len(out) - filled)
            if not piece:
                raise InvalidFile(Problem(self._key, f"ends after {self.taken:,} bytes", f"{self._info.file_size:,}"))
            out[filled : filled + len(piece)] = piece
            filled += len(piece)
            self.taken += len(piece)

    def _next(self, most: int) -> bytes:
        if self._inflate is None:
            piece = bytes(self._packed[self._at : self._at + most])
            self._at += len(piece)
            return piece
        while not self._inflate.eof:
            data: Any = self._inflate.unconsumed_tail
            if not data:
                data = self._packed[self._at : self._at + _CHUNK]
                self._at += len(data)
            piece = self._inflate.decompress(data, min(most, _CHUNK))
            if piece:
                self._crc = zlib_ng.crc32(piece, self._crc)
                return piece
            if not len(data) and self._at >= len(self._packed):
                break
        return b""

    def finish(self) -> None:
        """Raises InvalidFile if the stream goes on or its CRC is wrong."""
        if self._next(1):
            raise InvalidFile(Problem(self._key, "goes on past its declared end", f"{self._info.file_size:,} bytes"))
        if self._crc != self._info.CRC:
            raise InvalidFile(Problem(self._key, f"has CRC-32 {self._crc:08x}", f"{self._info.CRC:08x}"))
