"""Protocol Buffers' wire format, as far as a message of numbers, text, bytes and packed arrays needs it.

    tag, length, bytes      for strings, packed arrays and bytes
    tag, varint             for whole numbers                           tag = field << 3 | wire type

Written and read here because the library's messages hold a copy of every array, and serialising makes another.
Source: protobuf.dev/programming-guides/encoding.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.coding.varint import decode_varints, encode_varints

MAX_FIELDS = 10_000
_VARINT, _FIXED64, _BYTES, _FIXED32 = 0, 1, 2, 5


def number_field(number: int, value: int) -> bytes:
    """A whole number of 32 bits."""
    return _varint(number << 3 | _VARINT) + _varint(value)


def bytes_field(number: int, data: bytes) -> bytes:
    """Text, bytes or a packed array."""
    return bytes_head(number, len(data)) + data


def bytes_head(number: int, size: int) -> bytes:
    """What stands before so many bytes that the writer hands over by itself."""
    return _varint(number << 3 | _BYTES) + _varint(size)


def _varint(value: int) -> bytes:
    return encode_varints(np.array([value], np.int32))


class Message:
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

    def whole_numbers(self, number: int, name: str) -> npt.NDArray[np.int32]:
        """A packed array of varints; `name` is what messages call it."""
        packed = self.packed(number)
        memory.require(name, len(packed))
        memory.hold(name, 4 * int(np.count_nonzero(packed < 0x80)))  # so many numbers end
        return decode_varints(packed)

    def floats(self, number: int, name: str, dtype: str) -> npt.NDArray[Any]:
        """A packed array of numbers of this dtype."""
        return floats_in(self.packed(number), name, dtype)


def floats_in(raw: memoryview | npt.NDArray[np.uint8], name: str, dtype: str) -> npt.NDArray[Any]:
    """Bytes as numbers of this dtype, a view. Raises InvalidFile where they are no whole number of them."""
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
