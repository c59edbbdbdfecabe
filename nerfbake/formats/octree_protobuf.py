"""The octree as the Protocol Buffers message of TR-24-01's listing 3 (.svo.pb); schema: schemas/svo.proto.

    tag, length, bytes      for strings, packed arrays and node_data
    tag, varint             for width, height, depth, data_dim          tag = field << 3 | wire type

The wire is written and read here, without the protobuf library: its messages hold a copy of every array, and
serialising makes another. These bytes are the same as the library's (a test compares them), the node values are
handed over as they stand in memory or are made, and a file's node values are read as a view of the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats._octree import (
    MAX_2GIB,
    SMALL_SIZE,
    TYPE_URLS,
    Blob,
    Profile,
    blob_of,
    children_with,
    octree_of,
    require_size,
    value_pieces,
)
from nerfbake.kernels.parallel import ahead
from nerfbake.kernels.varint import decode_varints, encode_varints, varint_sizes
from nerfbake.scene.octree import SparseVoxelOctree

MAX_FIELDS = 10_000
_CHUNK = 1 << 18
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def recognise(head: bytes) -> bool:
    """True for the first bytes of the message: a type_url, as every known writer gives one."""
    return head[:1] == b"\x0a" and b"type.googleapis.com/" in head[:64]


def encode(
    octree: SparseVoxelOctree, *, no_child: int = 0, profile: Profile = "report"
) -> Iterator[bytes | memoryview]:
    """The message in pieces, fields in the order of their numbers. Raises InvalidScene above protobuf's 2 GiB.

    report: listing 3 field for field, children as varints. bulk: the children as they stand in memory, in a field of
    their own, which a reader of listing 3 alone does not know.
    """
    flat = octree.node_children.reshape(-1)
    chunks = [flat[start : start + _CHUNK] for start in range(0, len(flat), _CHUNK)]
    sizes = (varint_sizes(children_with(chunk, no_child)) for chunk in chunks)
    children_size = sum(sizes) if profile == "report" else flat.nbytes
    require_size("svo.pb", children_size + octree.node_rows.nbytes + SMALL_SIZE, MAX_2GIB, "protobuf's limit")
    yield _bytes(1, TYPE_URLS[octree.node_rows.dtype.name].encode())
    for number, edge in enumerate(octree.size, start=2):
        yield _varint(number << 3 | _VARINT) + _varint(edge)
    if children_size and profile == "report":
        yield _varint(5 << 3 | _BYTES) + _varint(children_size)
        yield from ahead(encode_varints(children_with(chunk, no_child)) for chunk in chunks)
    yield _varint(6 << 3 | _BYTES) + _varint(octree.node_rows.nbytes)
    yield from value_pieces(octree)
    if octree.data_format:
        yield _bytes(7, octree.data_format.encode())
    yield _varint(8 << 3 | _VARINT) + _varint(octree.data_dim)
    yield _bytes(9, encode_varints(np.array(octree.level_sizes, np.int32)))
    yield _bytes(10, octree.origin.astype("<f8").tobytes())
    yield _bytes(11, octree.voxel_size.astype("<f8").tobytes())
    if octree.extra_data is not None:
        yield _bytes(12, octree.extra_data.astype("<f4").tobytes())
    if children_size and profile == "bulk":
        yield _varint(13 << 3 | _BYTES) + _varint(children_size)
        yield blob_of(children_with(octree.node_children, no_child)).data


def decode(view: memoryview) -> SparseVoxelOctree:
    """The octree of a message. Fields 7 and up may be absent: the report's own files have none of them."""
    message = _Message(view)
    packed_children = message.packed(5)
    children: Any = _whole_numbers(packed_children, "node_children")
    if len(bulk := message.last(13)):
        if len(packed_children):
            raise InvalidFile(Problem("message", "has fields 5 and 13", "the children once"))
        children = Blob("<i4", (len(bulk) // 32, 8), bulk)
    dtype = "<f2" if message.text(1) == TYPE_URLS["float16"] else "<f4"
    return octree_of(
        {
            "type_url": message.text(1),
            "width": message.number(2),
            "height": message.number(3),
            "depth": message.number(4),
            "node_children": children,
            "node_data": _floats(message.last(6), "node_data", dtype),
            "data_format": message.text(7),
            "data_dim": message.number(8),
            "level_sizes": _whole_numbers(message.packed(9), "level_sizes"),
            "origin": _floats(message.packed(10), "origin", "<f8"),
            "voxel_size": _floats(message.packed(11), "voxel_size", "<f8"),
            "extra_data": _floats(message.packed(12), "extra_data", "<f4"),
        }
    )


def _varint(value: int) -> bytes:
    return encode_varints(np.array([value], np.int32))


def _bytes(number: int, data: bytes) -> bytes:
    return _varint(number << 3 | _BYTES) + _varint(len(data)) + data


class _Message:
    """The fields of a message by number, their payloads as views. Unknown fields are skipped."""

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
                    Problem("message", f"has more than {MAX_FIELDS:,} fields", "arrays packed, as listing 3 has them")
                )
            self._fields.setdefault(number, []).append((wire, value))

    def _of(self, number: int, wire: int) -> list[Any]:
        found = self._fields.get(number, [])
        for got, _ in found:
            if got != wire:
                raise InvalidFile(
                    Problem(f"field {number}", f"has wire type {got}", f"{wire}, as svo.proto declares it")
                )
        return [value for _, value in found]

    def number(self, number: int) -> int:
        """An int32; 0 where absent."""
        values = self._of(number, _VARINT)
        return (((values[-1] & 0xFFFFFFFF) ^ 0x80000000) - 0x80000000) if values else 0

    def last(self, number: int) -> memoryview:
        """A bytes field; the last one counts."""
        values = self._of(number, _BYTES)
        return values[-1] if values else memoryview(b"")

    def text(self, number: int) -> str:
        try:
            return bytes(self.last(number)).decode()
        except UnicodeDecodeError:
            raise InvalidFile(Problem(f"field {number}", "is no UTF-8", "text")) from None

    def packed(self, number: int) -> npt.NDArray[np.uint8]:
        """A packed array's bytes; a writer may have cut it into several runs."""
        runs = [np.frombuffer(run, np.uint8) for run in self._of(number, _BYTES)]
        memory.hold(f"field {number}", sum(map(len, runs)) if len(runs) > 1 else 0)
        return runs[0] if len(runs) == 1 else np.concatenate(runs or [np.empty(0, np.uint8)])


def _whole_numbers(packed: npt.NDArray[np.uint8], name: str) -> npt.NDArray[np.int32]:
    memory.require(name, len(packed))
    memory.hold(name, 4 * int(np.count_nonzero(packed < 0x80)))  # so many numbers end
    return decode_varints(packed)


def _floats(raw: memoryview | npt.NDArray[np.uint8], name: str, dtype: str) -> npt.NDArray[Any]:
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
