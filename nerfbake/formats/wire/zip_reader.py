"""Read the members of untrusted zip archives, and list the arrays of an .npz.

ZipReader follows the central directory. It checks the declared size of a member against the memory limit before it
inflates the member, and checks CRCs. Stored members are views of the file.

npz_keys() lists the names in the directory, which distinguish the formats with the extension .npz:

    ... | central directory: PK 01 02, 46 bytes | name | extra | comment, for each member
        | [PK 06 06, 56 bytes, with the directory's size and offset in 64 bits | PK 06 07, 20 bytes]
        | PK 05 06, 22 bytes | comment

Members are in any order and the directory is at the end, so the first bytes of a file do not identify its format.
npz_keys() reads at most MAX_MEMBERS names and MAX_DIRECTORY bytes, whatever the archive declares. If an archive is cut
off, it returns the name in the first member's local header, so that the right format reports the error.
Source: PKWARE's APPNOTE.TXT, 4.3.12, 4.3.14 to 4.3.16.
"""

from __future__ import annotations

import io
import struct
import warnings
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from copy import copy

import deflate

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem

_NO_PLAIN_DATA = 1 | 1 << 5 | 1 << 6 | 1 << 13  # flags: encrypted, patched, encrypted strongly, masked headers
MAX_INFLATION = 1032  # limit of deflate: 258 bytes for a quarter of a byte


class ZipReader:
    """The members of an archive by name. what: the expected file, for error messages."""

    def __init__(self, view: memoryview, what: str) -> None:
        self._view = view
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # duplicate names are rejected below
                members = zipfile.ZipFile(_ViewFile(view)).infolist()
        except (zipfile.BadZipFile, NotImplementedError, ValueError, EOFError, OSError, struct.error) as error:
            raise InvalidFile(f"is not a complete zip archive ({error}); allowed: {what}") from None
        if len(members) > MAX_MEMBERS:
            raise InvalidFile(Problem("zip directory", f"lists {len(members):,} members", f"{MAX_MEMBERS} at most"))
        self.members = {info.filename: info for info in members}
        if len(self.members) != len(members):
            raise InvalidFile(Problem("zip directory", "lists a name twice", "each name once"))

    def unpacked(self, name: str, key: str, *, damaged: bool = False) -> memoryview:
        """Return all bytes of a member. Raises InvalidFile if they are cut off or damaged, MemoryLimit.

        key: the name in error messages. damaged: accept a CRC that differs from the directory's.
        """
        info = self.members[name]
        raw = self._packed(key, info)
        if info.compress_type == zipfile.ZIP_DEFLATED:
            memory.hold(key, info.file_size)
            try:
                raw = memoryview(deflate.deflate_decompress(raw, info.file_size))
            except deflate.DeflateError:
                allowed = f"a whole deflate stream of {info.file_size:,} bytes"
                raise InvalidFile(Problem(key, "continues past its declared end, or is damaged", allowed)) from None
            if len(raw) < info.file_size:
                raise InvalidFile(Problem(key, f"ends after {len(raw):,} bytes", f"{info.file_size:,}"))
        if not damaged and (crc := deflate.crc32(raw)) != info.CRC:
            raise InvalidFile(Problem(key, f"has CRC-32 {crc:08x}", f"{info.CRC:08x}"))
        return raw

    def is_whole(self, name: str, raw: memoryview) -> bool:
        """True if these bytes of a member have the CRC in the directory."""
        return int(deflate.crc32(raw)) == self.members[name].CRC

    def _packed(self, key: str, info: zipfile.ZipInfo) -> memoryview:
        """Return the member's bytes in the file, after a check of the directory against the local header."""
        if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or info.flag_bits & _NO_PLAIN_DATA:
            found = f"uses zip method {info.compress_type}, flags 0x{info.flag_bits:x}"
            raise InvalidFile(Problem(key, found, "stored or deflated, not encrypted"))
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


class ZipFolder(Mapping[str, memoryview]):
    """The files of an archive, or of a folder in it, by name. `what`: the expected file, for error messages.

    Files that macOS adds for itself are not among them.
    """

    def __init__(self, view: memoryview, what: str) -> None:
        self._zip = ZipReader(view, what)
        self._at = ""
        self._names = own_names(self._zip.members)

    def below(self, folder: str) -> ZipFolder:
        """The files in a folder ('' or 'NAME/'), by their names in it."""
        found = copy(self)
        found._at = self._at + folder
        found._names = [name.removeprefix(folder) for name in self._names if name.startswith(folder)]
        return found

    def __getitem__(self, name: str) -> memoryview:
        if name not in self:
            raise KeyError(name)
        return self._zip.unpacked(self._at + name, name)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def own_names(names: Iterable[str]) -> list[str]:
    """The names of an archive's files, without folders and the files that macOS adds: __MACOSX/*, ._* and .DS_Store."""
    parts = {name: name.split("/") for name in names}
    return [
        name
        for name, (*folders, last) in parts.items()
        if last and not last.startswith("._") and last != ".DS_Store" and "__MACOSX" not in folders[:1]
    ]


class _ViewFile(io.RawIOBase):
    """A memoryview as a seekable file for zipfile, without a copy.

    zipfile reads the whole directory and uses ten bytes for each of its bytes before the members can be counted. So
    read() limits the size of the directory.
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


ZIP_MAGIC = (b"PK\x03\x04", b"PK\x05\x06")


MAX_MEMBERS = 1000


MAX_DIRECTORY = 1 << 20  # bytes: a thousand entries as NumPy and svox write them take a tenth


_MAX_TEXT = 0xFFFF  # bytes: limit of a name and of the archive's comment


def npz_keys(view: memoryview) -> frozenset[str]:
    """Return the names of an archive's arrays, without .npy; empty if the file is not an archive."""
    if bytes(view[:4]) not in ZIP_MAGIC:
        return frozenset()
    return _listed(_directory(view)) or _first(bytes(view[: _HEADER_SIZE + _MAX_TEXT]))


def _listed(entries: bytes) -> frozenset[str]:
    """The names in a central directory."""
    keys: set[str] = set()
    at = 0
    for _ in range(MAX_MEMBERS):
        if entries[at : at + 4] != _ENTRY or len(entries) - at < _ENTRY_SIZE:
            break
        name_size, *others = struct.unpack_from("<3H", entries, at + 28)
        name = at + _ENTRY_SIZE
        keys.add(_key(entries[name : name + name_size]))
        at = name + name_size + sum(others)
    return frozenset(keys)


def _first(head: bytes) -> frozenset[str]:
    """The name of the member at the start of an archive, if any."""
    if head[:4] != ZIP_MAGIC[0] or len(head) < _HEADER_SIZE:
        return frozenset()
    (name_size,) = struct.unpack_from("<H", head, 26)
    return frozenset([_key(head[_HEADER_SIZE : _HEADER_SIZE + name_size])])


def _key(name: bytes) -> str:
    return name.decode(errors="replace").removesuffix(".npy")


def _directory(view: memoryview) -> bytes:
    """The central directory, found in the same way as zipfile finds it; empty if there is none."""
    first = max(0, len(view) - _END_SIZE - _MAX_TEXT)
    tail = bytes(view[first:])
    at = tail.rfind(_END)
    if at < 0 or len(tail) - at < _END_SIZE:
        return b""
    size = struct.unpack_from("<I", tail, at + 12)[0]
    end = first + at
    before = bytes(view[max(0, end - _LOCATOR64_SIZE - _END64_SIZE) : end])
    wide = before[-_LOCATOR64_SIZE:][:4] == _LOCATOR64 and before[:4] == _END64
    if wide and len(before) == _LOCATOR64_SIZE + _END64_SIZE:
        size = struct.unpack_from("<Q", before, 40)[0]
        end -= len(before)
    return bytes(view[end - size : end][:MAX_DIRECTORY]) if size <= end else b""


_ENTRY, _END, _END64, _LOCATOR64 = b"PK\x01\x02", b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"


_HEADER_SIZE, _ENTRY_SIZE, _END_SIZE, _END64_SIZE, _LOCATOR64_SIZE = 30, 46, 22, 56, 20
