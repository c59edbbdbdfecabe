"""FlatBuffers' wire format, as far as tables of whole numbers, text, vectors and tables need it.

    file      u32 offset of the root table | 4 letters that name the schema | objects
    table     i32 back to its vtable | fields, 4 bytes each: an i32, or a u32 offset forward to an object
    vtable    u16 its size | u16 the table's size | u16 a field: where it stands in the table, 0 if it does not
    vector    u32 length | elements, aligned          text: a vector of bytes, and a zero behind it

Written here because the Python library copies every vector into its builder (docs/wires.md has what that costs). Read
by the library, which has no verifier: nothing that a file says is followed before it is known to lie inside the file.
Source: flatbuffers.dev/internals.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any

import flatbuffers
import numpy as np
import numpy.typing as npt
from flatbuffers import encode, number_types

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.blob import blob_of

# A field of a table to write: None where it is absent.
Field = int | str | npt.NDArray[Any] | Sequence[Any] | None

_LONGEST = 2**31 - 1
# What a vector may be read as, in the runtime's words.
_VECTORS: dict[str, Any] = {
    "u1": number_types.Uint8Flags,
    "<i4": number_types.Int32Flags,
    "<u8": number_types.Uint64Flags,
    "<f4": number_types.Float32Flags,
    "<f8": number_types.Float64Flags,
}


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
    """A table in a file that nobody has vouched for; every offset is bounded before the runtime follows it."""

    def __init__(self, view: memoryview, place: int) -> None:
        _require_inside(view, place, 4)
        self._view, self._place = view, place
        self._table = flatbuffers.Table(view, place)
        vtable = place - self._number(place, number_types.SOffsetTFlags)
        self._vtable_size, self._size = (self._number(at, number_types.VOffsetTFlags) for at in (vtable, vtable + 2))
        if self._vtable_size < 4 or vtable + self._vtable_size > len(view) or place + self._size > len(view):
            found = f"has a vtable of {self._vtable_size} bytes at {vtable:,}"
            raise InvalidFile(Problem(f"table at byte {place:,}", found, "a table inside the file"))

    @staticmethod
    def root(view: memoryview) -> Table:
        if len(view) > _LONGEST:  # the runtime knows no place beyond
            raise InvalidFile(Problem("the file", f"has {len(view):,} bytes", f"{_LONGEST:,}, FlatBuffers' limit"))
        _require_inside(view, 0, 4)
        return Table(view, encode.Get(number_types.UOffsetTFlags.packer_type, view, 0))

    def number(self, slot: int) -> int:
        """An int32; 0 where absent."""
        at = self._at(slot)
        return self._number(self._place + at, number_types.Int32Flags) if at else 0

    def text(self, slot: int) -> str:
        """Text; '' where absent."""
        try:
            return self.array(slot, "u1").tobytes().decode()
        except UnicodeDecodeError:
            raise InvalidFile(Problem(f"field {slot}", "is no UTF-8", "text")) from None

    def array(self, slot: int, dtype: str) -> npt.NDArray[Any]:
        """A vector of _VECTORS' numbers as a view of the file; empty where absent."""
        flags, at = _VECTORS[dtype], self._at(slot)
        if not at:
            return np.empty(0, dtype)
        start = self._follow(at)
        size = self._number(start, number_types.UOffsetTFlags) * flags.bytewidth
        if start + 4 + size > len(self._view):
            found = f"has {size:,} bytes at {start + 4:,}"
            raise InvalidFile(Problem(f"field {slot}", found, f"a vector that ends by {len(self._view):,}"))
        return np.asarray(self._table.GetVectorAsNumpy(flags, at))

    def table(self, slot: int) -> Table | None:
        at = self._at(slot)
        return Table(self._view, self._follow(at)) if at else None

    def _at(self, slot: int) -> int:
        """Where in the table a field stands; 0 where it is absent."""
        if 4 + 2 * slot + 2 > self._vtable_size:
            return 0
        offset = int(self._table.Offset(4 + 2 * slot))
        if offset and not 4 <= offset <= self._size - 4:
            found = f"puts field {slot} at {offset} of {self._size} bytes"
            raise InvalidFile(Problem(f"table at byte {self._place:,}", found, "fields inside the table"))
        return offset

    def _follow(self, at: int) -> int:
        """Where in the file that begins what a field of the table points to."""
        return self._place + at + self._number(self._place + at, number_types.UOffsetTFlags)

    def _number(self, at: int, flags: Any) -> int:
        _require_inside(self._view, at, flags.bytewidth)
        return int(self._table.Get(flags, at))


def _require_inside(view: memoryview, at: int, size: int) -> None:
    """Raises InvalidFile unless `size` bytes from `at` on lie in the file: below 0 the runtime counts from its end."""
    if not 0 <= at <= len(view) - size:
        raise InvalidFile(Problem("an offset", f"leads to byte {at:,}", f"0 to {len(view):,}"))
