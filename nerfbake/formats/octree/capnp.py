"""Read and write octrees as Cap'n Proto structs (.svo.capnp); schema: schemas/svo.capnp.

    report   nodeChildren List(Int32), nodeData List(Float32): float16 values are widened, Cap'n Proto has no half
    bulk     childrenBlob, dataBlob: dtype, shape and bytes; float16 stays float16; a blob has 512 MiB at most

In both profiles arrays are written from memory without a copy, and read as views of the file. Other readers limit how
much they traverse: set their traversal limit to the file's size, in words of 8 bytes.

The module implements the part of the wire format that structs of integers, text, lists and structs need:

    file      u32 segments - 1 | u32 words in each | padding to 8 | segments; a word is 8 bytes
    struct    data words | pointer words
    pointers  bits 0..1   2..31                          32..63
              0 struct    signed offset in words         u16 data words, u16 pointer words
              1 list      signed offset in words         3 bits of element size, 29 bits of count
              2 far       1 bit: double; 29 bits: word   u32 segment

Offsets count from the word after the pointer. A far pointer refers to a word of another segment. That word contains the
real pointer or, if the far pointer is double, a far pointer to the content, followed by the tag of the struct or list.

pycapnp is not used: it copies every array into its builder, and needs a compiler or a wheel. The reader checks that
every pointer target lies inside the file before it follows the pointer, and reads every field once, so it needs no
traversal limit. Source: capnproto.org/encoding.html.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.octree.fields import TABLE, NoChild, Profile, VoxelType, octree_from_table, table_of
from nerfbake.formats.wire.blob import blob_of
from nerfbake.scene.octree import SparseVoxelOctree

MAX_COUNT = 2**29 - 1  # elements of a list; for a blob, bytes
MAX_SEGMENTS = 512
_STRUCT, _LIST, _FAR = 0, 1, 2
_ELEMENT_SIZES = {1: 2, 2: 3, 4: 4, 8: 5}  # bytes: Cap'n Proto's code

# A pointer field to write; None if it is absent.
Field = str | npt.NDArray[Any] | Sequence[Any] | None


def write_struct(numbers: Sequence[int], fields: Sequence[Field]) -> list[bytes | memoryview]:
    """Return the pieces of a file with one segment; arrays are not copied.

    numbers: int32 fields in order. fields: pointer fields in order; a nested struct is the list of its pointers.
    Raises InvalidScene for an array with more elements than a list can count.
    """
    root = bytearray(8)
    pieces: list[bytearray | memoryview] = [root]
    words = 1

    def add(*new: bytearray | memoryview) -> int:
        """Append an object, pad it to whole words, and return its offset in words."""
        nonlocal words
        place, size = words, sum(map(len, new))
        pieces.extend((*new, bytearray(-size % 8)))
        words += -(-size // 8)
        return place

    # Queue of objects to append: (object, piece that contains its pointer, offset in that piece, pointer's word).
    waiting: list[tuple[Any, bytearray, int, int]] = [((numbers, fields), root, 0, 0)]
    while waiting:
        item, pointer, at, word = waiting.pop(0)
        if isinstance(item, str):
            item = np.frombuffer(item.encode() + b"\0", np.uint8)
        if isinstance(item, np.ndarray):
            if item.size > MAX_COUNT:
                allowed = f"{MAX_COUNT:,}, a Cap'n Proto list's limit (bytes, or numbers with `profile=report`)"
                raise InvalidScene(Problem("svo.capnp", f"would need a list of {item.size:,} elements", allowed))
            found = add(blob_of(item).data)
            description = item.size << 3 | _ELEMENT_SIZES[item.itemsize]
            kind = _LIST
        else:
            values, children = item
            data = struct.pack(f"<{len(values)}i", *values)
            data += bytes(-len(data) % 8)
            body = bytearray(8 * len(children))
            found = add(bytearray(data), body)
            description, kind = len(data) // 8 | len(children) << 16, _STRUCT
            first = found + len(data) // 8
            waiting += [
                (child if isinstance(child, str | np.ndarray) else ((), child), body, 8 * k, first + k)
                for k, child in enumerate(children)
                if child is not None
            ]
        struct.pack_into("<iI", pointer, at, (found - word - 1) << 2 | kind, description)
    return [struct.pack("<II", 0, words), *(memoryview(piece) for piece in pieces)]


class _Pointer(NamedTuple):
    """The kind and position of an object, and the upper 32 bits of its pointer."""

    kind: int
    segment: int
    word: int
    description: int


class CapnpMessage:
    """The segments of an untrusted file."""

    def __init__(self, view: memoryview) -> None:
        count = 1 + int.from_bytes(view[:4], "little")
        head = (4 + 4 * count + 7) // 8 * 8
        if count > MAX_SEGMENTS or head > len(view):
            raise InvalidFile(Problem("segment table", f"has {count:,} segments", f"1 to {MAX_SEGMENTS}, all there"))
        sizes = [8 * size for size in struct.unpack_from(f"<{count}I", view, 4)]
        if head + sum(sizes) != len(view):
            found = f"adds up to {head + sum(sizes):,} bytes"
            raise InvalidFile(Problem("segment table", found, f"{len(view):,}, as the file has"))
        ends = np.cumsum([head, *sizes]).tolist()
        self.segments = [view[start:end] for start, end in pairwise(ends)]

    @property
    def root(self) -> CapnpStruct:
        found = self.follow(0, 0)
        if found is None:
            raise InvalidFile(Problem("root", "is a null pointer", "a struct"))
        return CapnpStruct(self, found)

    def follow(self, segment: int, word: int) -> _Pointer | None:
        """Return the target of the pointer in this word; None for a null pointer."""
        low, high = struct.unpack("<iI", self.words(segment, word, 1))
        if low == high == 0:
            return None
        if low & 3 != _FAR:
            return _Pointer(low & 3, segment, word + 1 + (low >> 2), high)
        pad, double = (low & 0xFFFFFFFF) >> 3, low & 4
        low2, high2 = struct.unpack("<iI", self.words(high, pad, 1))
        if not double and low2 & 3 != _FAR:
            return _Pointer(low2 & 3, high, pad + 1 + (low2 >> 2), high2)
        tag, description = struct.unpack("<iI", self.words(high, pad + 1, 1)) if double else (_FAR, 0)
        if tag & 3 == _FAR or low2 & 7 != _FAR:
            place = f"segment {high}, word {pad:,}"
            raise InvalidFile(Problem(place, "is not a landing pad", "a valid target of a far pointer"))
        return _Pointer(tag & 3, high2, (low2 & 0xFFFFFFFF) >> 3, description)

    def words(self, segment: int, word: int, count: int) -> memoryview:
        """Return words of a segment. Raises InvalidFile if they lie outside it."""
        if segment >= len(self.segments) or word < 0 or 8 * (word + count) > len(self.segments[segment]):
            place = f"segment {segment}, word {word:,}"
            raise InvalidFile(Problem(place, f"is pointed to as the start of {count:,} words", "words inside the file"))
        return self.segments[segment][8 * word : 8 * (word + count)]


class CapnpStruct:
    """A struct in a message. Fields beyond its sections are absent, as in files of older writers."""

    def __init__(self, message: CapnpMessage, pointer: _Pointer) -> None:
        if pointer.kind != _STRUCT:
            raise InvalidFile(Problem("a pointer", f"is of kind {pointer.kind}", "0, a struct"))
        self._message, self._segment = message, pointer.segment
        data, self._pointers = pointer.description & 0xFFFF, pointer.description >> 16
        self._first = pointer.word + data
        self._data = message.words(pointer.segment, pointer.word, data + self._pointers)[: 8 * data]

    def number(self, index: int) -> int:
        """The int32 field at byte 4 * index; 0 if absent."""
        if 4 * index + 4 > len(self._data):
            return 0
        return int(struct.unpack_from("<i", self._data, 4 * index)[0])

    def text(self, index: int) -> str:
        raw = self.array(index, "u1").tobytes()
        if raw[-1:] not in (b"", b"\0"):
            raise InvalidFile(Problem(f"pointer {index}", "is text without its end", "a zero after the text"))
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise InvalidFile(Problem(f"pointer {index}", "is not UTF-8", "text")) from None

    def array(self, index: int, dtype: str) -> npt.NDArray[Any]:
        """A list as a view of the file; empty if absent."""
        found = self._follow(index)
        if found is None:
            return np.empty(0, dtype)
        code, count = found.description & 7, found.description >> 3
        itemsize = np.dtype(dtype).itemsize
        if found.kind != _LIST or code != _ELEMENT_SIZES[itemsize]:
            what = f"is of kind {found.kind}, element size {code}"
            raise InvalidFile(Problem(f"pointer {index}", what, f"a list of {dtype}"))
        words = self._message.words(found.segment, found.word, -(-count * itemsize // 8))
        return np.frombuffer(words, dtype, count)

    def table(self, index: int) -> CapnpStruct | None:
        found = self._follow(index)
        return CapnpStruct(self._message, found) if found else None

    def _follow(self, index: int) -> _Pointer | None:
        return self._message.follow(self._segment, self._first + index) if index < self._pointers else None


_DATA_WORDS, _POINTERS = 2, 10  # section sizes of the schema's struct
_MAX_SECTION = 64
# Numbers and pointers are counted apart.
_NUMBERS = [name for name, kind in TABLE.items() if kind == "number"]
_OBJECTS = [name for name, kind in TABLE.items() if kind != "number"]
_INDEX = {name: k for names in (_NUMBERS, _OBJECTS) for k, name in enumerate(names)}


def recognise(view: memoryview) -> bool:
    """True for a segment table followed by a pointer to a struct at least as large as the schema's."""
    head = bytes(view[:HEAD])
    if len(head) < 16:
        return False
    count = 1 + int.from_bytes(head[:4], "little")
    kind, data, pointers = struct.unpack("<IHH", head[(4 + 4 * count + 7) // 8 * 8 :][:8].ljust(8, b"\xff"))
    return bool(kind & 3 == 0) and _DATA_WORDS <= data < _MAX_SECTION and _POINTERS <= pointers < _MAX_SECTION


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "bulk",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """Yield the message in pieces. Raises InvalidScene for an array that a Cap'n Proto list cannot count."""
    fields = table_of(octree, no_child=no_child, profile=profile, voxel_type=voxel_type)
    numbers, pointers = ([value for value in fields if isinstance(value, int) == whole] for whole in (True, False))
    yield from write_struct(numbers, pointers)


def decode(view: memoryview) -> SparseVoxelOctree:
    """Read an octree of either profile; its arrays are views of the file."""
    return octree_from_table(CapnpMessage(view).root, _INDEX)
