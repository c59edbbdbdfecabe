"""FlatBuffers' wire format, as far as tables of whole numbers, text, vectors and tables need it.

    file      u32 offset of the root table | 4 letters that name the schema | objects
    table     i32 back to its vtable | fields, 4 bytes each: an i32, or a u32 offset forward to an object
    vtable    u16 its size | u16 the table's size | u16 a field: where it stands in the table, 0 if it does not
    vector    u32 length | elements, aligned          text: a vector of bytes, and a zero behind it

Written and read here because the Python library copies every vector into its builder, and has no verifier: nothing
that a file says is followed before it is known to lie inside the file. Source: flatbuffers.dev/internals.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.blob import blob_of

# A field of a table to write: None where it is absent.
Field = int | str | npt.NDArray[Any] | Sequence[Any] | None


def write_table(fields: Sequence[Field], identifier: bytes) -> list[memoryview]:
    """The file's pieces; arrays are handed over as they are. A nested table is a list of fields."""
    pieces: list[bytearray | memoryview] = []
    size = 0

    def add(piece: bytearray | memoryview, *, align: int = 4, before: int = 0) -> int:
        """Appends a piece so that what stands `before` bytes into it is aligned; gives its place."""
        nonlocal size
        padding = -(size + before) % align
        pieces.append(bytearray(padding))
        pieces.append(piece)
        size += padding + len(piece)
        return size - len(piece)

    head = bytearray(4) + identifier
    add(head)
    # Objects still to be placed: (what, the piece that points to it, where in that piece, where in the file).
    waiting: list[tuple[Any, bytearray, int, int]] = [(fields, head, 0, 0)]
    while waiting:
        item, pointer, at, place = waiting.pop(0)
        if isinstance(item, str):
            text = item.encode()
            found = add(bytearray(struct.pack("<I", len(text)) + text + b"\0"))
        elif isinstance(item, np.ndarray):
            found = add(bytearray(struct.pack("<I", item.size)), align=max(4, item.itemsize), before=4)
            add(blob_of(item).data, align=1)
        else:
            vtable, table, objects = _table(item)
            add(vtable)
            found = add(table)
            struct.pack_into("<i", table, 0, len(vtable))
            waiting += [(field, table, offset, found + offset) for field, offset in objects]
        struct.pack_into("<I", pointer, at, (found - place) & 0xFFFFFFFF)
    return [memoryview(piece) for piece in pieces]


def _table(fields: Sequence[Field]) -> tuple[bytearray, bytearray, list[tuple[Any, int]]]:
    """A table's vtable, its bytes, and its objects with the place of their offsets."""
    slots, body, objects = [], bytearray(4), []
    for field in fields:
        slots.append(0 if field is None else len(body))
        if isinstance(field, int):
            body += struct.pack("<i", field)
        elif field is not None:
            objects.append((field, len(body)))
            body += bytes(4)
    vtable = struct.pack(f"<HH{len(slots)}H", 4 + 2 * len(slots), len(body), *slots)
    return bytearray(vtable.ljust(-(-len(vtable) // 4) * 4, b"\0")), body, objects


class Table:
    """A table in a file that nobody has vouched for; every offset is bounded before it is used."""

    def __init__(self, view: memoryview, place: int) -> None:
        self._view, self._place = view, place
        back = self._int(place, "<i")
        self._vtable = place - back
        self._vtable_size, self._size = self._int(self._vtable, "<H"), self._int(self._vtable + 2, "<H")
        if self._vtable_size < 4 or self._vtable + self._vtable_size > len(view) or place + self._size > len(view):
            found = f"has a vtable of {self._vtable_size} bytes at {self._vtable:,}"
            raise InvalidFile(Problem(f"table at byte {place:,}", found, "a table inside the file"))

    @staticmethod
    def root(view: memoryview) -> Table:
        return Table(view, _read(view, 0, "<I"))

    def number(self, slot: int) -> int:
        """An int32; 0 where absent."""
        at = self._at(slot)
        return self._int(at, "<i") if at else 0

    def text(self, slot: int) -> str:
        """Text; '' where absent."""
        try:
            return bytes(self._vector(slot, 1)).decode()
        except UnicodeDecodeError:
            raise InvalidFile(Problem(f"field {slot}", "is no UTF-8", "text")) from None

    def array(self, slot: int, dtype: str) -> npt.NDArray[Any]:
        """A vector as a view of the file; empty where absent."""
        return np.frombuffer(self._vector(slot, np.dtype(dtype).itemsize), dtype)

    def table(self, slot: int) -> Table | None:
        at = self._at(slot)
        return Table(self._view, at + self._int(at, "<I")) if at else None

    def _at(self, slot: int) -> int:
        """Where in the file a field stands; 0 where it is absent."""
        if 4 + 2 * slot + 2 > self._vtable_size:
            return 0
        offset = self._int(self._vtable + 4 + 2 * slot, "<H")
        if offset and not 4 <= offset <= self._size - 4:
            found = f"puts field {slot} at {offset} of {self._size} bytes"
            raise InvalidFile(Problem(f"table at byte {self._place:,}", found, "fields inside the table"))
        return self._place + offset if offset else 0

    def _vector(self, slot: int, itemsize: int) -> memoryview:
        at = self._at(slot)
        if not at:
            return memoryview(b"")
        start = at + self._int(at, "<I")
        size = self._int(start, "<I") * itemsize
        if start + 4 + size > len(self._view):
            found = f"has {size:,} bytes at {start + 4:,}"
            raise InvalidFile(Problem(f"field {slot}", found, f"a vector that ends by {len(self._view):,}"))
        return self._view[start + 4 : start + 4 + size]

    def _int(self, at: int, kind: str) -> int:
        return _read(self._view, at, kind)


def _read(view: memoryview, at: int, kind: str) -> int:
    if not 0 <= at <= len(view) - struct.calcsize(kind):
        raise InvalidFile(Problem("an offset", f"leads to byte {at:,}", f"0 to {len(view):,}"))
    return int(struct.unpack_from(kind, view, at)[0])
