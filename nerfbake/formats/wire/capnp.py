"""Cap'n Proto's wire format, as far as structs of whole numbers, text, lists and structs need it.

    file      u32 segments - 1 | u32 words in each | padding to 8 | segments; a word is 8 bytes
    struct    data words | pointer words
    pointers  bits 0..1   2..31                          32..63
              0 struct    signed offset in words         u16 data words, u16 pointer words
              1 list      signed offset in words         3 bits of element size, 29 bits of count
              2 far       1 bit: double; 29 bits: word   u32 segment

Offsets count from the word behind the pointer. A far pointer names a word of another segment that holds the real
pointer, or, if double, a far pointer to the content with the struct's or list's description behind it.

Written and read here because pycapnp copies every array into its builder, and needs a compiler or a wheel. Nothing that
a file says is followed before it is known to lie inside it, every field is read once, and so no traversal limit is
needed. Source: capnproto.org/encoding.html.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.wire.blob import blob_of

MAX_COUNT = 2**29 - 1  # elements of a list, and so bytes of a blob
MAX_SEGMENTS = 512
_STRUCT, _LIST, _FAR = 0, 1, 2
_ELEMENT_SIZES = {1: 2, 2: 3, 4: 4, 8: 5}  # bytes: Cap'n Proto's code

# A pointer field to write: None where it is absent.
Field = str | npt.NDArray[Any] | Sequence[Any] | None


def write_struct(numbers: Sequence[int], fields: Sequence[Field]) -> list[bytes | memoryview]:
    """The file's pieces, one segment; arrays are handed over as they are.

    numbers: int32 fields in order; fields: the pointers in order, a nested struct a list of its pointers.
    Raises InvalidScene for an array with more elements than a list can count.
    """
    root = bytearray(8)
    pieces: list[bytearray | memoryview] = [root]
    words = 1

    def add(*new: bytearray | memoryview) -> int:
        """Appends an object and pads it to whole words; gives its place in words."""
        nonlocal words
        place, size = words, sum(map(len, new))
        pieces.extend((*new, bytearray(-size % 8)))
        words += -(-size // 8)
        return place

    # Objects still to be placed: (what, the piece that points to it, where in that piece, that pointer's word).
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
    """Where an object starts, and its 32 bits of description."""

    kind: int
    segment: int
    word: int
    description: int


class Message:
    """The segments of a file that nobody has vouched for."""

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
    def root(self) -> Struct:
        found = self.follow(0, 0)
        if found is None:
            raise InvalidFile(Problem("root", "is a null pointer", "a struct"))
        return Struct(self, found)

    def follow(self, segment: int, word: int) -> _Pointer | None:
        """What the pointer in this word points to; None for a null pointer."""
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
            raise InvalidFile(Problem(place, "is no landing pad", "what a far pointer may point to"))
        return _Pointer(tag & 3, high2, (low2 & 0xFFFFFFFF) >> 3, description)

    def words(self, segment: int, word: int, count: int) -> memoryview:
        """Words of a segment, known to be there."""
        if segment >= len(self.segments) or word < 0 or 8 * (word + count) > len(self.segments[segment]):
            place = f"segment {segment}, word {word:,}"
            raise InvalidFile(Problem(place, f"is pointed to as the start of {count:,} words", "words inside the file"))
        return self.segments[segment][8 * word : 8 * (word + count)]


class Struct:
    """A struct in a message; fields beyond its sections read as absent, as those of an older writer must."""

    def __init__(self, message: Message, pointer: _Pointer) -> None:
        if pointer.kind != _STRUCT:
            raise InvalidFile(Problem("a pointer", f"is of kind {pointer.kind}", "0, a struct"))
        self._message, self._segment = message, pointer.segment
        data, self._pointers = pointer.description & 0xFFFF, pointer.description >> 16
        self._first = pointer.word + data
        self._data = message.words(pointer.segment, pointer.word, data + self._pointers)[: 8 * data]

    def number(self, index: int) -> int:
        """The int32 field at 4 * index bytes; 0 where absent."""
        if 4 * index + 4 > len(self._data):
            return 0
        return int(struct.unpack_from("<i", self._data, 4 * index)[0])

    def text(self, index: int) -> str:
        raw = self.array(index, "u1").tobytes()
        if raw[-1:] not in (b"", b"\0"):
            raise InvalidFile(Problem(f"pointer {index}", "is text without its end", "a zero behind text"))
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError:
            raise InvalidFile(Problem(f"pointer {index}", "is no UTF-8", "text")) from None

    def array(self, index: int, dtype: str) -> npt.NDArray[Any]:
        """A list as a view of the file; empty where absent."""
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

    def struct(self, index: int) -> Struct | None:
        found = self._follow(index)
        return Struct(self._message, found) if found else None

    def _follow(self, index: int) -> _Pointer | None:
        return self._message.follow(self._segment, self._first + index) if index < self._pointers else None
