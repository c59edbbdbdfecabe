"""Read and write octrees as the Protocol Buffers message of TR-24-01's listing 3 (docs/sources.md): .svo.pb.

The schema is schemas/svo.proto. The bytes are the same as those of the protobuf library (a test compares them). The
library is not used: its messages contain a copy of every array, and serialising makes another. Here node values are
written from memory or as they are computed, and read as a view of the file.

The module implements the part of the wire format that a message of numbers, text, bytes and packed arrays needs:

    tag, length, bytes      for strings, packed arrays and bytes
    tag, varint             for whole numbers                           tag = field << 3 | wire type

type_url gives the number type of the node values. If it is a voxel type, it also names every value:

    type.googleapis.com/google.protobuf.FloatValue      float32: the type in TR-24-01
    type.googleapis.com/svo.protobuf.Float16Value       float16
    type.googleapis.com/svo.protobuf.SH9Voxel           float32, and a node is an SH9Voxel of schemas/voxels.proto
    type.googleapis.com/svo.protobuf.SH9HalfVoxel       float16, and the same

The layout of node_data is the same for all of them.
Sources: protobuf.dev/programming-guides/encoding; TR-24-01 (docs/sources.md), 3.3 and 5.1.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.octree.fields import (
    MAX_2GIB,
    SMALL_SIZE,
    NoChild,
    Profile,
    VoxelType,
    children_with,
    octree_from_fields,
    require_size,
    stored_dtype,
    type_url_of,
)
from nerfbake.formats.wire.blob import Blob, blob_of, row_pieces
from nerfbake.kernels.coding.varint import decode_varints, encode_varints, varint_sizes
from nerfbake.kernels.parallel import prefetched
from nerfbake.scene.octree import SparseVoxelOctree

MAX_FIELDS = 10_000
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def number_field(number: int, value: int) -> bytes:
    """Encode a field with a 32-bit integer."""
    return _varint(number << 3 | _VARINT) + _varint(value)


def bytes_field(number: int, data: bytes) -> bytes:
    """Encode a field with text, bytes or a packed array."""
    return bytes_head(number, len(data)) + data


def bytes_head(number: int, size: int) -> bytes:
    """Encode the tag and length of a field with `size` bytes; the caller writes the bytes."""
    return _varint(number << 3 | _BYTES) + _varint(size)


def _varint(value: int) -> bytes:
    return encode_varints(np.array([value], np.int32))


class ProtobufMessage:
    """The fields of a message by number, with their payloads as views. Unknown fields are ignored."""

    def __init__(self, view: memoryview) -> None:
        self._fields: dict[int, list[tuple[int, Any]]] = {}
        at, count = 0, 0
        while at < len(view):
            start = at
            tag, at = _read_varint(view, at)
            number, wire = tag >> 3, tag & 7
            value: Any
            if wire == _VARINT:
                value, at = _read_varint(view, at)
            elif wire in (_BYTES, _FIXED64, _FIXED32):
                size, at = _read_varint(view, at) if wire == _BYTES else (8 if wire == _FIXED64 else 4, at)
                value = view[at : at + size]
                at += size
            else:
                raise InvalidFile(Problem(f"byte {start:,}", f"has wire type {wire}", "0, 1, 2 or 5"))
            if at > len(view) or not number:
                found = f"starts field {number} of {at - start:,} bytes"
                raise InvalidFile(Problem(f"byte {start:,}", found, f"fields from 1 that end by {len(view):,}"))
            count += 1
            if count > MAX_FIELDS:
                raise InvalidFile(
                    Problem("message", f"has more than {MAX_FIELDS:,} fields", "packed arrays, as in listing 3")
                )
            self._fields.setdefault(number, []).append((wire, value))

    def _of(self, number: int, wire: int) -> list[Any]:
        found = self._fields.get(number, [])
        for got, _ in found:
            if got != wire:
                raise InvalidFile(
                    Problem(f"field {number}", f"has wire type {got}", f"{wire}, as declared in svo.proto")
                )
        return [value for _, value in found]

    def number(self, number: int) -> int:
        """An int32; 0 if absent."""
        values = self._of(number, _VARINT)
        return (((values[-1] & 0xFFFFFFFF) ^ 0x80000000) - 0x80000000) if values else 0

    def last(self, number: int) -> memoryview:
        """A bytes field; of several occurrences the last one."""
        values = self._of(number, _BYTES)
        return values[-1] if values else memoryview(b"")

    def text(self, number: int) -> str:
        try:
            return bytes(self.last(number)).decode()
        except UnicodeDecodeError:
            raise InvalidFile(Problem(f"field {number}", "is not UTF-8", "text")) from None

    def packed(self, number: int) -> npt.NDArray[np.uint8]:
        """The bytes of a packed array, which may be split over several occurrences of the field."""
        runs = [np.frombuffer(run, np.uint8) for run in self._of(number, _BYTES)]
        memory.hold(f"field {number}", sum(map(len, runs)) if len(runs) > 1 else 0)
        return runs[0] if len(runs) == 1 else np.concatenate(runs or [np.empty(0, np.uint8)])

    def whole_numbers(self, number: int, name: str) -> npt.NDArray[np.int32]:
        """A packed array of varints; `name` is its name in messages."""
        packed = self.packed(number)
        memory.require(name, len(packed))
        memory.hold(name, 4 * int(np.count_nonzero(packed < 0x80)))  # a byte below 0x80 ends a number
        return decode_varints(packed)

    def floats(self, number: int, name: str, dtype: str) -> npt.NDArray[Any]:
        """A packed array of numbers of this dtype."""
        return floats_in(self.packed(number), name, dtype)


def floats_in(raw: memoryview | npt.NDArray[np.uint8], name: str, dtype: str) -> npt.NDArray[Any]:
    """View bytes as numbers of this dtype. Raises InvalidFile if their count is not a multiple of its size."""
    if len(raw) % np.dtype(dtype).itemsize:
        raise InvalidFile(Problem(name, f"has {len(raw):,} bytes", f"a multiple of {np.dtype(dtype).itemsize}"))
    return np.frombuffer(raw, dtype)


def _read_varint(view: memoryview, at: int) -> tuple[int, int]:
    value = 0
    for k in range(10):
        if at + k >= len(view):
            break
        byte = view[at + k]
        value |= (byte & 0x7F) << 7 * k
        if byte < 0x80:
            return value, at + k + 1
    raise InvalidFile(Problem(f"byte {at:,}", "starts a varint that does not end", "10 bytes, inside the file"))


_CHUNK = 1 << 18


def recognise(view: memoryview) -> bool:
    """True for a message that begins with a type_url, as the messages of all known writers do."""
    head = bytes(view[:HEAD])
    return head[:1] == b"\x0a" and b"type.googleapis.com/" in head[:64]


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "report",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """Yield the message in pieces, fields in the order of their numbers. Raises InvalidScene above protobuf's 2 GiB.

    report: the fields of listing 3, with the children as varints. bulk: the children as they are in memory, in an
    additional field that readers of listing 3 alone do not read.
    """
    flat = octree.node_children.reshape(-1)
    chunks = [flat[start : start + _CHUNK] for start in range(0, len(flat), _CHUNK)]
    sizes = (varint_sizes(children_with(chunk, no_child)) for chunk in chunks)
    children_size = sum(sizes) if profile == "report" else flat.nbytes
    require_size("svo.pb", children_size + octree.node_rows.nbytes + SMALL_SIZE, MAX_2GIB, "protobuf's limit")
    yield bytes_field(1, type_url_of(octree, voxel_type).encode())
    for number, edge in enumerate(octree.size, start=2):
        yield number_field(number, edge)
    if children_size and profile == "report":
        yield bytes_head(5, children_size)
        yield from prefetched(encode_varints(children_with(chunk, no_child)) for chunk in chunks)
    yield bytes_head(6, octree.node_rows.nbytes)
    yield from row_pieces(octree.node_rows)
    if octree.data_format:
        yield bytes_field(7, octree.data_format.encode())
    yield number_field(8, octree.data_dim)
    yield bytes_field(9, encode_varints(np.array(octree.level_sizes, np.int32)))
    yield bytes_field(10, octree.origin.astype("<f8").tobytes())
    yield bytes_field(11, octree.voxel_size.astype("<f8").tobytes())
    if octree.extra_data is not None:
        yield bytes_field(12, octree.extra_data.astype("<f4").tobytes())
    if children_size and profile == "bulk":
        yield bytes_head(13, children_size)
        yield blob_of(children_with(octree.node_children, no_child)).data


def decode(view: memoryview) -> SparseVoxelOctree:
    """Read the octree of a message. Fields 7 and up may be absent, as in the files of TR-24-01."""
    message = ProtobufMessage(view)
    children: Any = message.whole_numbers(5, "node_children")
    if len(bulk := message.last(13)):
        if len(children):
            raise InvalidFile(Problem("message", "has fields 5 and 13", "the children once"))
        children = Blob("<i4", (len(bulk) // 32, 8), bulk)
    return octree_from_fields(
        {
            "type_url": message.text(1),
            "width": message.number(2),
            "height": message.number(3),
            "depth": message.number(4),
            "node_children": children,
            "node_data": floats_in(message.last(6), "node_data", stored_dtype(message.text(1)).str),
            "data_format": message.text(7),
            "data_dim": message.number(8),
            "level_sizes": message.whole_numbers(9, "level_sizes"),
            "origin": message.floats(10, "origin", "<f8"),
            "voxel_size": message.floats(11, "voxel_size", "<f8"),
            "extra_data": message.floats(12, "extra_data", "<f4"),
        }
    )
