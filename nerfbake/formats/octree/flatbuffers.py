"""Read and write octrees as FlatBuffers tables (.svo.fb); schema: schemas/svo.fbs.

    report   node_children [int], node_data [float]: float16 values are widened, FlatBuffers has no half
    bulk     children_blob, data_blob: dtype, shape and bytes; float16 stays float16

In both profiles arrays are written from memory without a copy, and read as views of the file.

The module implements the part of the wire format that tables of integers, text, vectors and tables need:

    file      u32 offset of the root table | 4 letters that name the schema | objects
    table     i32 back to its vtable | fields, 4 bytes each: an i32, or a u32 offset forward to an object
    vtable    u16 its size | u16 the table's size | u16 for each field: its offset in the table, 0 if absent
    vector    u32 length | elements, aligned          text: a vector of bytes, followed by a zero

The writer does not use the Python library, which copies every vector into its builder (docs/wires.md lists the cost).
The reader uses the library. The library has no verifier, so the reader checks that every offset lies inside the file
before it follows the offset. Source: flatbuffers.dev/internals.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Any

import flatbuffers
import numpy as np
import numpy.typing as npt
from flatbuffers import encode as packing
from flatbuffers import number_types

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.octree.fields import (
    MAX_2GIB,
    SMALL_SIZE,
    TABLE,
    NoChild,
    Profile,
    VoxelType,
    octree_from_table,
    require_size,
    table_of,
)
from nerfbake.formats.wire.blob import blob_of
from nerfbake.scene.octree import SparseVoxelOctree

# A field of a table to write; None if it is absent.
Field = int | str | npt.NDArray[Any] | Sequence[Any] | None

_LONGEST = 2**31 - 1
# The dtypes of vectors, and the library's types for them.
_VECTORS: dict[str, Any] = {
    "u1": number_types.Uint8Flags,
    "<i4": number_types.Int32Flags,
    "<u8": number_types.Uint64Flags,
    "<f4": number_types.Float32Flags,
    "<f8": number_types.Float64Flags,
}


def write_table(fields: Sequence[Field], identifier: bytes) -> list[memoryview]:
    """Return the pieces of a file; arrays are not copied. A nested table is a list of fields."""
    pieces: list[bytearray | memoryview] = []
    size = 0

    def add(piece: bytearray | memoryview, *, align: int = 4, before: int = 0) -> int:
        """Append a piece so that its byte `before` is aligned, and return its offset."""
        nonlocal size
        padding = -(size + before) % align
        pieces.append(bytearray(padding))
        pieces.append(piece)
        size += padding + len(piece)
        return size - len(piece)

    head = bytearray(4) + identifier
    add(head)
    # Queue of objects to append: (object, piece that contains its offset, position there, position in the file).
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
    """Return a table's vtable, its bytes, and its objects with the positions of their offsets."""
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


class FlatbuffersTable:
    """A table in an untrusted file; every offset is checked before the library follows it."""

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
    def root(view: memoryview) -> FlatbuffersTable:
        if len(view) > _LONGEST:  # the library's offsets end here
            raise InvalidFile(Problem("the file", f"has {len(view):,} bytes", f"{_LONGEST:,}, FlatBuffers' limit"))
        _require_inside(view, 0, 4)
        return FlatbuffersTable(view, packing.Get(number_types.UOffsetTFlags.packer_type, view, 0))

    def number(self, slot: int) -> int:
        """An int32; 0 if absent."""
        at = self._at(slot)
        return self._number(self._place + at, number_types.Int32Flags) if at else 0

    def text(self, slot: int) -> str:
        """Text; '' if absent."""
        try:
            return self.array(slot, "u1").tobytes().decode()
        except UnicodeDecodeError:
            raise InvalidFile(Problem(f"field {slot}", "is not UTF-8", "text")) from None

    def array(self, slot: int, dtype: str) -> npt.NDArray[Any]:
        """A vector of a dtype in _VECTORS as a view of the file; empty if absent."""
        flags, at = _VECTORS[dtype], self._at(slot)
        if not at:
            return np.empty(0, dtype)
        start = self._follow(at)
        size = self._number(start, number_types.UOffsetTFlags) * flags.bytewidth
        if start + 4 + size > len(self._view):
            found = f"has {size:,} bytes at {start + 4:,}"
            raise InvalidFile(Problem(f"field {slot}", found, f"a vector that ends by {len(self._view):,}"))
        return np.asarray(self._table.GetVectorAsNumpy(flags, at))

    def table(self, slot: int) -> FlatbuffersTable | None:
        at = self._at(slot)
        return FlatbuffersTable(self._view, self._follow(at)) if at else None

    def _at(self, slot: int) -> int:
        """The offset of a field in the table; 0 if absent."""
        if 4 + 2 * slot + 2 > self._vtable_size:
            return 0
        offset = int(self._table.Offset(4 + 2 * slot))
        if offset and not 4 <= offset <= self._size - 4:
            found = f"puts field {slot} at {offset} of {self._size} bytes"
            raise InvalidFile(Problem(f"table at byte {self._place:,}", found, "fields inside the table"))
        return offset

    def _follow(self, at: int) -> int:
        """The offset in the file of the object that a field of the table points to."""
        return self._place + at + self._number(self._place + at, number_types.UOffsetTFlags)

    def _number(self, at: int, flags: Any) -> int:
        _require_inside(self._view, at, flags.bytewidth)
        return int(self._table.Get(flags, at))


def _require_inside(view: memoryview, at: int, size: int) -> None:
    """Raise InvalidFile unless the `size` bytes at `at` lie in the file; the library counts a negative `at` from its
    end."""
    if not 0 <= at <= len(view) - size:
        raise InvalidFile(Problem("an offset", f"points to byte {at:,}", f"0 to {len(view):,}"))


IDENTIFIER = b"SVO1"
_INDEX = {name: k for k, name in enumerate(TABLE)}


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a file with the schema's identifier."""
    return bytes(view[4:8]) == IDENTIFIER


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "bulk",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """Yield the file in pieces. Raises InvalidScene above FlatBuffers' limit of 2 GiB."""
    widened = 4 if profile == "report" else octree.node_data.itemsize
    size = octree.node_children.nbytes + octree.node_data.size * widened + SMALL_SIZE
    require_size("svo.fb", size, MAX_2GIB, "FlatBuffers' limit")
    fields = table_of(octree, no_child=no_child, profile=profile, voxel_type=voxel_type)
    yield from write_table(fields, IDENTIFIER)


def decode(view: memoryview) -> SparseVoxelOctree:
    """Read an octree of either profile; its arrays are views of the file."""
    return octree_from_table(FlatbuffersTable.root(view), _INDEX)
