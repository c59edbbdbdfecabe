"""What an .npz holds, by the names in its archive's directory: how formats that share this ending are told apart.

    ... | central directory: PK 01 02, 46 bytes | name | extra | comment, for each member
        | [PK 06 06, 56 bytes, with the directory's size and place in 64 bits | PK 06 07, 20 bytes]
        | PK 05 06, 22 bytes | comment

Members stand in any order and the directory at the end, so that a file's first bytes do not tell. At most MAX_MEMBERS
names and MAX_DIRECTORY bytes are looked at, whatever the archive claims. Of one that was cut short the first member's
own header still tells a name, so that it is the right format that complains.
Source: PKWARE's APPNOTE.TXT, 4.3.12, 4.3.14 to 4.3.16.
"""

from __future__ import annotations

import struct

ZIP_MAGIC = (b"PK\x03\x04", b"PK\x05\x06")
MAX_MEMBERS = 1000
MAX_DIRECTORY = 1 << 20  # bytes: a thousand names with what NumPy and svox write beside them take a tenth

_ENTRY, _END, _END64, _LOCATOR64 = b"PK\x01\x02", b"PK\x05\x06", b"PK\x06\x06", b"PK\x06\x07"
_HEADER_SIZE, _ENTRY_SIZE, _END_SIZE, _END64_SIZE, _LOCATOR64_SIZE = 30, 46, 22, 56, 20
_MAX_TEXT = 0xFFFF  # bytes of a name or of the archive's comment


def npz_keys(view: memoryview) -> frozenset[str]:
    """The names of an archive's arrays, without .npy; none for what is no archive."""
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
    """The name of the member that an archive starts with, if it starts with one."""
    if head[:4] != ZIP_MAGIC[0] or len(head) < _HEADER_SIZE:
        return frozenset()
    (name_size,) = struct.unpack_from("<H", head, 26)
    return frozenset([_key(head[_HEADER_SIZE : _HEADER_SIZE + name_size])])


def _key(name: bytes) -> str:
    return name.decode(errors="replace").removesuffix(".npy")


def _directory(view: memoryview) -> bytes:
    """The central directory, found as zipfile finds it; empty where there is none."""
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
