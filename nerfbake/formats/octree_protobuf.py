"""The octree as the Protocol Buffers message of TR-24-01's listing 3 (.svo.pb); schema: schemas/svo.proto.

    tag, length, bytes      for strings, packed arrays and node_data
    tag, varint             for width, height, depth, data_dim          tag = field << 3 | wire type

The wire is written and read here, without the protobuf library: its messages hold a copy of every array, and
serialising makes another. These bytes are the same as the library's (a test compares them), the node values are
handed over as they stand in memory, and a file's node values are read as a view of the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit, Problem
from nerfbake.formats._octree import assemble, children_with
from nerfbake.kernels.varint import decode_varints, encode_varints, varint_sizes
from nerfbake.scene.basis import guess_data_format, parse_basis
from nerfbake.scene.octree import SparseVoxelOctree

TYPE_URLS = {
    "float32": "type.googleapis.com/google.protobuf.FloatValue",
    "float16": "type.googleapis.com/svo.protobuf.Float16Value",
}
MAX_MESSAGE = 2**31 - 1
MAX_FIELDS = 10_000
_CHUNK = 1 << 18
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def recognise(head: bytes) -> bool:
    """True for the first bytes of the message: a type_url, as every known writer gives one."""
    return head[:1] == b"\x0a" and b"type.googleapis.com/" in head[:64]


def encode(octree: SparseVoxelOctree, *, no_child: int = 0) -> Iterator[bytes | memoryview]:
    """The message in pieces, fields in the order of their numbers. Raises InvalidScene above protobuf's 2 GiB."""
    flat = octree.node_children.reshape(-1)
    chunks = [flat[start : start + _CHUNK] for start in range(0, len(flat), _CHUNK)]
    children_size = sum(varint_sizes(children_with(chunk, no_child)) for chunk in chunks)
    if (size := children_size + octree.node_data.nbytes + 4096) > MAX_MESSAGE:
        raise InvalidScene(Problem("svo.pb", f"would take {size:,} bytes", f"{MAX_MESSAGE:,}, protobuf's limit"))
    dtype = octree.node_data.dtype
    yield _bytes(1, TYPE_URLS[dtype.name].encode())
    for number, edge in enumerate(octree.size, start=2):
        yield _varint(number << 3 | _VARINT) + _varint(edge)
    if children_size:
        yield _varint(5 << 3 | _BYTES) + _varint(children_size)
        for chunk in chunks:
            yield encode_varints(children_with(chunk, no_child))
    yield _varint(6 << 3 | _BYTES) + _varint(octree.node_data.nbytes)
    little = np.ascontiguousarray(octree.node_data, dtype.newbyteorder("<"))
    yield little.reshape(-1).view(np.uint8).data
    if octree.data_format:
        yield _bytes(7, octree.data_format.encode())
    yield _varint(8 << 3 | _VARINT) + _varint(octree.data_dim)
    yield _bytes(9, encode_varints(np.array(octree.level_sizes, np.int32)))
    yield _bytes(10, octree.origin.astype("<f8").tobytes())
    yield _bytes(11, octree.voxel_size.astype("<f8").tobytes())
    if octree.extra_data is not None:
        yield _bytes(12, octree.extra_data.astype("<f4").tobytes())


def decode(view: memoryview, *, max_memory: int) -> SparseVoxelOctree:
    """The octree of a message. Fields 7 and up may be absent: the report's own files have none of them."""
    message = _Message(view)
    type_url = message.text(1) or TYPE_URLS["float32"]
    if type_url not in TYPE_URLS.values():
        raise InvalidFile(Problem("type_url", f"is {type_url[:80]!r}", " or ".join(TYPE_URLS.values())))
    dtype = np.dtype("<f4" if type_url == TYPE_URLS["float32"] else "<f2")
    packed_children = message.packed(5)
    # Most varints here are one byte long and become four.
    if (need := 4 * len(packed_children)) > max_memory:
        raise MemoryLimit("node_children", need, max_memory)
    children = decode_varints(packed_children)
    if len(children) % 8:
        raise InvalidFile(Problem("node_children", f"has {len(children):,} numbers", "a multiple of 8"))
    level_sizes = decode_varints(message.packed(9)).astype(np.int64)
    data = message.last(6)
    n = int(level_sizes.sum()) if len(level_sizes) else len(children) // 8
    if n < 1 or (level_sizes < 0).any():
        raise InvalidFile(Problem("level_sizes", f"adds up to {n:,} nodes", "at least 1"))
    data_dim, rest = divmod(len(data), n * dtype.itemsize)
    if rest or not data_dim:
        found = f"has {len(data):,} bytes for {n:,} nodes"
        raise InvalidFile(Problem("node_data", found, f"a multiple of {n * dtype.itemsize:,}, not 0"))
    if message.number(8) not in (0, data_dim):
        raise InvalidFile(Problem("data_dim", f"is {message.number(8)}", f"{data_dim}, as many values as a node has"))
    octree = assemble(
        size=(message.number(2), message.number(3), message.number(4)),
        children=children.reshape(-1, 8),
        data=np.frombuffer(data, dtype).reshape(n, data_dim),
        data_format=message.text(7) or guess_data_format(data_dim),
        origin=message.doubles(10, 0.0),
        voxel_size=message.doubles(11, 1.0),
        extra_data=_lobes(message),
    )
    if len(level_sizes) and not octree.structure_problems() and octree.level_sizes != level_sizes.tolist():
        found = f"are {level_sizes.tolist()[:14]}"
        raise InvalidFile(Problem("level_sizes", found, f"{octree.level_sizes} as node_children says"))
    return octree


def _lobes(message: _Message) -> npt.NDArray[np.float32] | None:
    floats = message.packed(12)
    if not len(floats):
        return None
    size = parse_basis(message.text(7)).size
    if len(floats) % (4 * size):
        raise InvalidFile(Problem("extra_data", f"has {len(floats):,} bytes", f"a multiple of {4 * size}"))
    return np.frombuffer(floats.tobytes(), "<f4").reshape(size, -1).astype(np.float32)


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
        return runs[0] if len(runs) == 1 else np.concatenate(runs or [np.empty(0, np.uint8)])

    def doubles(self, number: int, default: float) -> npt.NDArray[np.float64]:
        """Three doubles, or three times the default where absent."""
        raw = self.packed(number)
        if not len(raw):
            return np.full(3, default)
        if len(raw) != 24:
            raise InvalidFile(Problem(f"field {number}", f"has {len(raw)} bytes", "24, three doubles"))
        return np.frombuffer(raw.tobytes(), "<f8").astype(np.float64)


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
