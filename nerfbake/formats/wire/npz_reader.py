"""NumPy's .npz archives, read as if a stranger had sent them.

Nothing is unpickled; zip_reader.py says what is asked of members, which are inflated at once and into the memory that
their array stays in (libdeflate takes half the time of zlib, and makes no copy on the way).
"""

from __future__ import annotations

import zipfile
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.npy import read_header
from nerfbake.formats.wire.zip_reader import ZipReader
from nerfbake.kernels.maths.casting import cast


class NpzReader:
    """The arrays of an archive, each read when it is asked for."""

    def __init__(self, view: memoryview) -> None:
        self._zip = ZipReader(view, "an .npz as NumPy writes it")
        members = self._zip.members
        self._members = {name.removesuffix(".npy"): info for name, info in members.items()}
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
        raw = self._zip.unpacked(info.filename, key)
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


def _sound_text(key: str, array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """The array. Raises InvalidFile for text that is no Unicode, of which Python makes strings that break later."""
    if array.dtype.kind == "U":
        points = np.ascontiguousarray(array).reshape(-1).view(np.uint32)
        if ((points > 0x10FFFF) | ((points >= 0xD800) & (points < 0xE000))).any():
            raise InvalidFile(Problem(key, "holds what is no Unicode", "text"))
    return array


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
