"""Read and write octrees as BSON documents (.svo.bson) with the field names of schemas/svo.proto.

    report   node_children an array of int32, node_data an array of doubles
    bulk     each a document {dtype, shape, data: binary}; the binary contains the array as it is in memory

The elements that an octree does not have are skipped, whatever they hold, so nothing nested is followed. A library
would create a Python object for every number and copy every blob. A test compares the bytes with those of pymongo's
bson.

    document   int32 size | elements | 00          element   type | name 00 | value

An array is a document whose names are "0", "1", "2", ...: 10 to 18 bytes a number. BSON's only float is the double;
widening to it is exact. Source: BSON 1.1, bsonspec.org.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.octree.fields import (
    MAX_2GIB,
    NoChild,
    Profile,
    VoxelType,
    children_with,
    octree_from_fields,
    require_size,
    small_fields,
)
from nerfbake.formats.wire.blob import Blob, blob_of
from nerfbake.scene.octree import SparseVoxelOctree

DOUBLE, _STRING, DOCUMENT, ARRAY, _BINARY, _BOOLEAN, _NULL, INT32, _INT64 = 1, 2, 3, 4, 5, 8, 10, 16, 18
_FIXED_SIZES = {DOUBLE: 8, 7: 12, _BOOLEAN: 1, 9: 8, _NULL: 0, INT32: 4, 17: 8, _INT64: 8, 19: 16}
_NUMBERS = {DOUBLE: "<f8", INT32: "<i4", _INT64: "<i8"}
_CHUNK = 1 << 18
_MAX_SMALL = 1 << 24
_MAX_ELEMENTS = 1000
_PER_NUMBER = 40  # bytes of a Python object and of its place in a list
_LARGE = ("node_children", "node_data")
_SMALL = ("type_url", "width", "height", "depth", "data_format", "data_dim")
_SMALL_ARRAYS = ("level_sizes", "origin", "voxel_size", "extra_data")


def document_of(fields: Mapping[str, Any]) -> bytes:
    """Encode text, numbers, and lists of them."""
    body = b"".join(_element(name, value) for name, value in fields.items())
    return struct.pack("<i", 4 + len(body) + 1) + body + b"\0"


def _element(name: str, value: str | float | list[float]) -> bytes:
    if isinstance(value, str):
        text = value.encode()
        kind, data = _STRING, struct.pack("<i", len(text) + 1) + text + b"\0"
    elif isinstance(value, float):
        kind, data = DOUBLE, struct.pack("<d", value)
    elif isinstance(value, list):
        kind, data = ARRAY, document_of({str(i): number for i, number in enumerate(value)})
    else:
        kind = INT32 if -(1 << 31) <= value < 1 << 31 else _INT64
        data = struct.pack("<i" if kind == INT32 else "<q", value)
    return bytes([kind]) + name.encode() + b"\0" + data


def document_head(small: dict[str, Any], *large: LargeElement) -> tuple[int, bytes]:
    """Return the size of the whole document, and the bytes of its size field and its small fields."""
    fields = document_of(small)[4:-1]
    size = 4 + len(fields) + sum(value.size for value in large) + 1
    return size, struct.pack("<I", size & 0xFFFFFFFF) + fields


class LargeElement(NamedTuple):
    """The element of a large array: its first bytes, its BSON type, and its size with the terminating zero."""

    head: bytes
    type: int
    size: int

    @staticmethod
    def of(name: str, values: npt.NDArray[Any], kind: int, *, blob: bool) -> LargeElement:
        """Describe the values as an array of numbers of BSON type `kind`, or as a blob."""
        if not blob:
            size = 5 + sum(len(rows) * _record(digits, kind).itemsize for digits, rows in _runs(values.size))
            head = struct.pack("<B", ARRAY) + name.encode() + b"\0" + struct.pack("<I", size & 0xFFFFFFFF)
            return LargeElement(head, kind, len(head) - 4 + size)
        dtype = values.dtype.newbyteorder("<")
        inner = document_of({"dtype": dtype.str, "shape": list(values.shape)})[4:-1] + b"\5data\0"
        nbytes = values.size * dtype.itemsize
        inner += struct.pack("<IB", nbytes & 0xFFFFFFFF, 0)
        size = 4 + len(inner) + nbytes + 1
        head = struct.pack("<B", DOCUMENT) + name.encode() + b"\0" + struct.pack("<I", size & 0xFFFFFFFF) + inner
        return LargeElement(head, _BINARY, len(head) + nbytes + 1)

    def pieces(self, values: npt.NDArray[Any]) -> Iterator[bytes | memoryview]:
        yield self.head
        if self.type == _BINARY:
            yield blob_of(values).data
        else:
            flat = values.reshape(-1)
            for digits, rows in _runs(len(flat)):
                for start in range(rows.start, rows.stop, _CHUNK):
                    part = range(start, min(start + _CHUNK, rows.stop))
                    records = _records(part, digits, self.type)
                    records["value"] = flat[part.start : part.stop]
                    yield records.view(np.uint8).data
        yield b"\0"


def _runs(count: int) -> Iterator[tuple[int, range]]:
    """Group the indices 0 to count - 1 by their number of digits: 1: 0..9, 2: 10..99, ..."""
    start, digits = 0, 1
    while start < count:
        yield digits, range(start, min(10**digits, count))
        start, digits = 10**digits, digits + 1


def _record(digits: int, kind: int) -> np.dtype[Any]:
    """The dtype of an array element whose index has this many digits; such elements have the same length."""
    return np.dtype([("type", "u1"), ("index", "u1", (digits,)), ("zero", "u1"), ("value", _NUMBERS[kind])])


def _records(rows: range, digits: int, kind: int) -> npt.NDArray[Any]:
    """The elements of these indices, with values of 0."""
    records = np.zeros(len(rows), _record(digits, kind))
    records["type"] = kind
    rest = np.arange(rows.start, rows.stop, dtype=np.uint32)
    for k in reversed(range(digits)):
        rest, digit = np.divmod(rest, np.uint32(10))
        records["index"][:, k] = digit + ord("0")
    return records


def numbers_in(document: memoryview, name: str) -> npt.NDArray[Any]:
    """Return the numbers of an array, of any mixture of BSON's types of numbers. Raises InvalidFile, MemoryLimit.

    If all have the same type, as in every file from a typed array, the array is compared in large pieces.
    """
    body = document[4:-1]
    kind = body[0] if len(body) else 0
    if kind in _NUMBERS:
        # Room for all numbers twice: in parts, and concatenated.
        size = len(body) // _record(1, kind).itemsize * np.dtype(_NUMBERS[kind]).itemsize
        memory.hold(name, size)
        memory.require(name, size)
        parts, at, index = [], 0, 0
        for digits, rows in _runs(len(body)):  # len(body) is an upper bound of the number of elements
            record = _record(digits, kind)
            count = min(len(rows), (len(body) - at) // record.itemsize)
            for start in range(index, index + count, _CHUNK):
                part = range(start, min(start + _CHUNK, index + count))
                found = np.frombuffer(body, record, len(part), at)
                expected = _records(part, digits, kind)
                if not all((found[key] == expected[key]).all() for key in ("type", "index", "zero")):
                    return _mixed(body, name)
                parts.append(found["value"])
                at += found.nbytes
            index += count
            if count < len(rows):
                break
        if at == len(body):
            return np.concatenate(parts)
    return _mixed(body, name)


def _mixed(body: memoryview, name: str) -> npt.NDArray[Any]:
    """The numbers of an array as int64, or as float64 if one of them is a double."""
    from nerfbake.kernels.coding.bson import fill_numbers, scan_numbers  # they compile on first use

    data = np.frombuffer(body, np.uint8)
    count, doubles = scan_numbers(data)
    if count < 0:
        raise InvalidFile(Problem(name, "holds a value that is not a number", "a flat list of numbers"))
    memory.hold(name, 8 * count)
    numbers = np.empty(count, np.int64)
    fill_numbers(data, doubles > 0, numbers, numbers.view(np.float64))
    return numbers.view(np.float64) if doubles else numbers


def _value_of(kind: int, value: memoryview, name: str) -> Any:
    """Decode a small field: a number, a Boolean, null, text, or a list of numbers. Raises InvalidFile, MemoryLimit."""
    if len(value) > _MAX_SMALL:
        raise InvalidFile(Problem(name, f"has {len(value):,} bytes", f"{_MAX_SMALL:,} in a small field"))
    if kind in _NUMBERS:
        return np.frombuffer(value, _NUMBERS[kind]).item()
    if kind == _BOOLEAN:
        return bool(value[0])
    if kind == _NULL:
        return None
    if kind == ARRAY:
        require_document(value, name)
        numbers = numbers_in(value, name)
        memory.hold(name, _PER_NUMBER * numbers.size)
        return numbers.tolist()
    if kind == _STRING:
        try:
            return str(value[4:-1], "utf-8")
        except UnicodeDecodeError:
            raise InvalidFile(Problem(name, "is not text", "UTF-8")) from None
    raise InvalidFile(Problem(name, f"has BSON type {kind}", "a number, text, or an array of numbers"))


def blob_in(document: memoryview, name: str) -> Blob:
    """Return the blob of a document {dtype, shape, data}. Raises InvalidFile, MemoryLimit."""
    found = elements_of(document, name)
    kind, value = found.get("data", (0, document))
    dtype, shape = (_value_of(*found[key], key) if key in found else None for key in ("dtype", "shape"))
    whole = isinstance(shape, list) and all(type(edge) is int for edge in shape)
    if not (kind == _BINARY and value[4] == 0 and isinstance(dtype, str) and whole):
        raise InvalidFile(Problem(name, "is not a blob", "dtype as text, shape as whole numbers, data as binary"))
    return Blob(dtype, tuple(shape or ()), value[5:])


def require_document(document: memoryview, name: str) -> None:
    """Raise InvalidFile if a document does not have the size that it declares, or does not end with a zero."""
    if len(document) < 5 or _size(document, 0) != len(document) or document[-1]:
        said = f"declares {_size(document, 0):,} of {len(document):,} bytes" if len(document) > 3 else "is cut off"
        raise InvalidFile(Problem(name, said, "a document that ends with the file and a zero"))


def elements_of(document: memoryview, name: str) -> dict[str, tuple[int, memoryview]]:
    """Return a document's elements by name, as BSON type and bytes of the value. Raises InvalidFile."""
    require_document(document, name)
    at, end = 4, len(document) - 1
    found: dict[str, tuple[int, memoryview]] = {}
    for _ in range(_MAX_ELEMENTS):
        if at == end:
            return found
        start, kind = at, document[at]
        key = bytes(document[at + 1 : min(at + 80, end)]).partition(b"\0")[0]
        at += 2 + len(key)
        size = _value_size(document, at, kind, start)
        if at + size > end:
            raise InvalidFile(Problem(f"byte {start:,}", f"starts {size:,} bytes", f"{end - at:,} up to the end"))
        found[key.decode("latin-1")] = (kind, document[at : at + size])
        at += size
    raise InvalidFile(Problem(name, f"has more than {_MAX_ELEMENTS:,} elements", "the fields of svo.proto"))


def _value_size(document: memoryview, at: int, kind: int, start: int) -> int:
    if kind in _FIXED_SIZES:
        return _FIXED_SIZES[kind]
    declared = _size(document, at) if at + 4 < len(document) else -1
    extra = {_STRING: 4, DOCUMENT: 0, ARRAY: 0, _BINARY: 5}.get(kind)
    if extra is None or declared < 0 or declared + extra < 5:
        found = f"starts BSON type {kind} of {declared:,} bytes"
        raise InvalidFile(Problem(f"byte {start:,}", found, "a number, text, array, document or binary"))
    return declared + extra


def _size(document: memoryview, at: int) -> int:
    return int(struct.unpack_from("<i", document, at)[0])


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a document with the fields of an octree."""
    head = bytes(view[:HEAD])
    known = len(head) > 5 and head[4] in (*_FIXED_SIZES, _STRING, ARRAY, DOCUMENT)  # the type of the first element
    return known and b"type_url\0" in head


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "bulk",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """Yield the document in pieces. Raises InvalidScene above BSON's limit of 2 GiB."""
    children = LargeElement.of("node_children", octree.node_children, INT32, blob=profile == "bulk")
    data = LargeElement.of("node_data", octree.node_data, DOUBLE, blob=profile == "bulk")
    size, head = document_head(small_fields(octree, voxel_type), children, data)
    require_size("svo.bson", size, MAX_2GIB, "BSON's limit")
    yield head
    yield from children.pieces(children_with(octree.node_children, no_child))
    yield from data.pieces(octree.node_data)
    yield b"\0"


def decode(view: memoryview) -> SparseVoxelOctree:
    """Read an octree of either profile; blobs are views of the file."""
    fields: dict[str, Any] = {}
    for name, (kind, value) in elements_of(view, "document").items():
        if name in (*_SMALL, *_SMALL_ARRAYS):
            fields[name] = _value_of(kind, value, name)
        elif name in _LARGE:
            fields[name] = _large_value(kind, value, name)
    return octree_from_fields(fields)


def _large_value(kind: int, value: memoryview, name: str) -> Any:
    if kind == ARRAY:
        require_document(value, name)
        return numbers_in(value, name)
    if kind == DOCUMENT:
        return blob_in(value, name)
    raise InvalidFile(Problem(name, f"has BSON type {kind}", "an array of numbers, or dtype, shape and data"))
