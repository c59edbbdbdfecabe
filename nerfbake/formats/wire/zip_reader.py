"""Zip archives, read as if a stranger had sent them: a member's bytes, as the central directory has them.

A member takes the memory that the directory declares, asked for before it is inflated; CRCs are checked; stored members
are views of the file.
"""

from __future__ import annotations

import io
import struct
import warnings
import zipfile

import deflate

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.npz_names import MAX_DIRECTORY, MAX_MEMBERS, ZIP_MAGIC

MAX_INFLATION = 1032  # deflate's own bound: 258 bytes for a quarter of a byte


class ZipReader:
    """The members of an archive by their names. what: what the archive should be, for errors."""

    def __init__(self, view: memoryview, what: str) -> None:
        self._view = view
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # duplicate names are ours to refuse
                members = zipfile.ZipFile(_ViewFile(view)).infolist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError, EOFError, OSError, struct.error) as error:
            raise InvalidFile(f"is no whole zip archive ({error}); allowed: {what}") from None
        if len(members) > MAX_MEMBERS:
            raise InvalidFile(Problem("zip directory", f"lists {len(members):,} members", f"{MAX_MEMBERS} at most"))
        self.members = {info.filename: info for info in members}
        if len(self.members) != len(members):
            raise InvalidFile(Problem("zip directory", "lists a name twice", "each name once"))

    def unpacked(self, name: str, key: str, *, damaged: bool = False) -> memoryview:
        """A member's bytes, of which none is missing or wrong. key: what errors call it. damaged: it may have another
        CRC than the directory says."""
        info = self.members[name]
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
        if not damaged and (crc := deflate.crc32(raw)) != info.CRC:
            raise InvalidFile(Problem(key, f"has CRC-32 {crc:08x}", f"{info.CRC:08x}"))
        return raw

    def is_whole(self, name: str, raw: memoryview) -> bool:
        """Whether these bytes of a member have the CRC that the directory says."""
        return int(deflate.crc32(raw)) == self.members[name].CRC

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
    """A memoryview as the seekable file that zipfile wants, without a copy of it.

    zipfile reads the directory whole, and makes ten bytes of each of its bytes before anybody can count its members.
    """

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
        if end - self._at > MAX_DIRECTORY:
            raise InvalidFile(Problem("zip directory", f"has {end - self._at:,} bytes", f"{MAX_DIRECTORY:,} at most"))
        piece = bytes(self._view[self._at : end])
        self._at += len(piece)
        return piece
