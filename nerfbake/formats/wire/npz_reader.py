"""NumPy's .npz archives, read as if a stranger had sent them.

Nothing is unpickled; a member takes the memory that the zip directory declares, asked for before it is inflated, at
once and into the memory that its array stays in (libdeflate takes half the time of zlib, and makes no copy on the way);
CRCs are checked; stored members become views of the file.
"""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from typing import Any

import deflate
import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.npy import read_header
from nerfbake.formats.wire.npz_names import MAX_MEMBERS, ZIP_MAGIC
from nerfbake.kernels.maths.casting import cast

MAX_INFLATION = 1032  # deflate's own bound: 258 bytes for a quarter of a byte


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

    @property
    def names(self) -> list[str]:
        """Of all members, in the order of the archive."""
        return list(self._members)

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
        return self._read(key, self._members[key], limit)

    def shaped(self, key: str, kinds: str, shape: tuple[int | None, ...]) -> npt.NDArray[Any]:
        """A member whose dtype is one of these kinds (NumPy's letters) and whose shape is this, None for any edge."""
        array = self.array(key)
        fits = array.ndim == len(shape) and all(a in (None, b) for a, b in zip(shape, array.shape, strict=True))
        if array.dtype.kind not in kinds or not fits:
            allowed = f"({', '.join('any' if edge is None else str(edge) for edge in shape)}) of kind {kinds}"
            raise InvalidFile(Problem(key, f"has dtype {array.dtype}, shape {array.shape}", allowed))
        return array

    def single(self, key: str) -> npt.NDArray[np.float32]:
        """A member of floats, as float32. Infinite is what that cannot hold."""
        array = self.array(key)
        if array.dtype.kind != "f":
            raise InvalidFile(Problem(key, f"has dtype {array.dtype}", "float16, float32 or float64"))
        memory.hold(key, 4 * array.size)
        return cast(array, np.float32)

    def _read(self, key: str, info: zipfile.ZipInfo, limit: int | None) -> npt.NDArray[Any]:
        if limit is not None and info.file_size > limit:
            raise InvalidFile(Problem(key, f"has {info.file_size:,} bytes", f"{limit:,} at most"))
        raw = self._unpacked(key, info)
        stream = _Bytes(key, raw)
        shape, fortran, dtype = read_header(key, stream)
        size = dtype.itemsize
        for edge in shape:  # Python's integers do not overflow
            size *= edge
        if stream.taken + size != len(raw):
            found = f"declares shape {shape} {dtype}, {stream.taken + size:,} bytes"
            raise InvalidFile(Problem(key, found, f"{len(raw):,} bytes as the zip directory says"))
        array = np.frombuffer(raw[stream.taken :], dtype) if size else np.empty(0, dtype)
        array = array.reshape(shape[::-1]).T if fortran else array.reshape(shape)
        if dtype.isnative:
            return _sound_text(key, array)
        memory.hold(key, size)
        return _sound_text(key, array.astype(dtype.newbyteorder("=")))

    def _unpacked(self, key: str, info: zipfile.ZipInfo) -> memoryview:
        """A member's bytes, of which none is missing or wrong."""
        raw = self._packed(key, info)
        if info.compress_type == zipfile.ZIP_DEFLATED:
            memory.hold(key, info.file_size)
            try:
                raw = memoryview(deflate.deflate_decompress(raw, info.file_size))
            except deflate.DeflateError:
                allowed = f"a whole deflate stream of {info.file_size:,} bytes"
                raise InvalidFile(Problem(key, "goes on past its declared end, or is damaged", allowed)) from None
            if len(raw) < info.file_size:
                raise InvalidFile(Problem(key, f"ends after {len(raw):,} bytes", f"{info.file_size:,}"))
        if (crc := deflate.crc32(raw)) != info.CRC:
            raise InvalidFile(Problem(key, f"has CRC-32 {crc:08x}", f"{info.CRC:08x}"))
        return raw

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


def _sound_text(key: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The array. Raises InvalidFile for text that is no Unicode, of which Python makes strings that break later."""
    if array.dtype.kind == "U":
        points = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
        if ((points > 0x10FFFF) | ((points >= 0xD800) & (points < 0xE000))).any():
            raise InvalidFile(Problem(key, "holds what is no Unicode", "text"))
    return array


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


class _Bytes:
    """A member's bytes in order."""

    def __init__(self, key: str, raw: memoryview) -> None:
        self._key, self._raw, self.taken = key, raw, 0

    def read(self, size: int) -> bytes:
        """Exactly `size` bytes."""
        piece = bytes(self._raw[self.taken : self.taken + size])
        if len(piece) < size:
            raise InvalidFile(Problem(self._key, f"ends after {len(self._raw):,} bytes", "an array (.npy)"))
        self.taken += size
        return piece
