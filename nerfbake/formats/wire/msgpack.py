r"""Read MessagePack: instant-ngp's snapshots and flax's checkpoints.

    00..7f  e0..ff        0 to 127, -32 to -1         c0  c2 c3              nil, false, true
    cc cd ce cf           u8, u16, u32, u64           d0 d1 d2 d3            i8, i16, i32, i64
    ca cb                 f32, f64                    c4 c5 c6 + size        bytes
    a0..bf  d9 da db      UTF-8 text of 0 to 31       90..9f  dc dd          a list of 0 to 15 values
      + size              bytes, or of `size` bytes     + count              values, or of `count` values
    80..8f  de df         a map of 0 to 15 pairs      d4 d5 d6 d7 d8 + type  an extension of 1, 2, 4, 8 or 16 bytes
      + count             key value, or of `count`    c7 c8 c9 + size type   an extension of `size` bytes
    c1                    invalid

Numbers, sizes and counts are big-endian; sizes and counts have 1, 2 or 4 bytes (counts 2 or 4).

flax's extensions 1 (an array) and 3 (a NumPy number) contain MessagePack: the list [shape, dtype's name, bytes], in C
order and little-endian. An array of more than 2^30 bytes is a map; its chunks are flat:

    {"__msgpack_chunked_array__": true, "shape": {"0": .., "1": ..}, "chunks": {"0": array, "1": array}}

A size or count is compared with the bytes that remain before anything is allocated. Memory is counted as it is used.

Source: https://github.com/msgpack/msgpack/blob/master/spec.md; flax/serialization.py.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Collection
from typing import Any, NoReturn

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import key_place, shorten

MAX_DEPTH = 64  # lists and maps within each other; checkpoints have about ten
MAX_DIMENSIONS = 8
_DEPTH_WITHIN = 2  # the same inside of an extension
_CHUNKED = "__msgpack_chunked_array__"
_DTYPES = {
    "bool": "|b1",
    **{f"{kind}int{8 * size}": f"<{kind or 'i'}{size}" for kind in ("", "u") for size in (1, 2, 4, 8)},
    **{f"float{8 * size}": f"<f{size}" for size in (2, 4, 8)},
    "bfloat16": "<u2",  # NumPy has no bfloat16: its bits are read as integers
}
# Bytes of Python objects: a number with its slot in a list; a pair of a map with its key's object; any other object.
_PER_VALUE, _PER_PAIR, _PER_OBJECT = 40, 220, 256

_CONSTANTS = {0xC0: None, 0xC2: False, 0xC3: True}
_NUMBERS = dict(zip(range(0xCA, 0xD4), [">f", ">d", ">B", ">H", ">I", ">Q", ">b", ">h", ">i", ">q"], strict=True))
_SIZED = {  # what it is, and the size or the layout of the size
    **{0x80 + count: ("map", count) for count in range(16)},
    **{0x90 + count: ("list", count) for count in range(16)},
    **{0xA0 + size: ("text", size) for size in range(32)},
    **{0xD4 + power: ("extension", 1 << power) for power in range(5)},
    **dict(zip((0xC4, 0xC5, 0xC6), [("bytes", layout) for layout in (">B", ">H", ">I")], strict=True)),
    **dict(zip((0xC7, 0xC8, 0xC9), [("extension", layout) for layout in (">B", ">H", ">I")], strict=True)),
    **dict(zip((0xD9, 0xDA, 0xDB), [("text", layout) for layout in (">B", ">H", ">I")], strict=True)),
    **dict(zip((0xDC, 0xDD), [("list", layout) for layout in (">H", ">I")], strict=True)),
    **dict(zip((0xDE, 0xDF), [("map", layout) for layout in (">H", ">I")], strict=True)),
}


def parse_map(view: memoryview, name: str, *, skip: Collection[str] = ()) -> dict[str, Any]:
    """Read a file whose only value is a map.

    Bytes become slices of `view`, without a copy. flax's arrays become arrays: views of `view` that need not be
    aligned, except bool, bfloat16 (as float32) and joined chunks, which are copies; flax's numbers become Python's.

    name: the file's name in errors, which add the offset. skip: keys that are left out and whose values are never
    built, with dots from the outermost map: `optimizer.state`. The memory counts as used until the end of the
    surrounding scope. Raises InvalidFile, MemoryLimit.
    """
    reader = _Reader(view, name, 0)
    value = reader.value(tuple(skip))
    if not isinstance(value, dict):
        reader.refuse(0, "does not begin with a map", "a map that contains everything")
    if rest := len(view) - reader.at:
        reader.refuse(reader.at, f"has {rest:,} bytes after the end of the map", "none")
    return value


class _Reader:
    """Reads values from the offset `at` on. within: inside of an extension, which contains no other."""

    def __init__(self, view: memoryview, name: str, at: int, *, within: bool = False) -> None:
        self._view, self._name, self.at, self._within = view, name, at, within
        self._deepest = _DEPTH_WITHIN if within else MAX_DEPTH

    def refuse(self, at: int, found: str, allowed: str) -> NoReturn:
        raise InvalidFile(Problem(f"{self._name} at byte {at:,}", found, allowed))

    def value(self, skip: tuple[str, ...] = (), depth: int = 0) -> Any:
        """Return the next value. depth: the number of lists and maps around it."""
        at = self.at
        kind, value = self._head()
        match kind:
            case "value":
                return value
            case "text":
                memory.hold(self._name, _PER_OBJECT + 4 * value)
                return self._text(at, value)
            case "bytes":
                memory.hold(self._name, _PER_OBJECT)
                return self._take(value)
            case "extension":
                memory.hold(self._name, 2 * _PER_OBJECT)
                return self._extension(at, value)
        if depth == self._deepest:
            self.refuse(at, f"has more than {depth} lists and maps inside each other", f"{depth} at most")
        if kind == "list":
            memory.hold(self._name, _PER_OBJECT + _PER_VALUE * value)
            return [self.value((), depth + 1) for _ in range(value)]
        memory.hold(self._name, _PER_OBJECT + _PER_PAIR * value)
        return self._map(at, value, skip, depth + 1)

    def _map(self, at: int, count: int, skip: tuple[str, ...], depth: int) -> Any:
        found: dict[str, Any] = {}
        passed = set()
        for _ in range(count):
            place = self.at
            kind, size = self._head()
            if kind != "text":
                self.refuse(place, "has a key that is not text", "text")
            memory.hold(self._name, 4 * size)
            key = self._text(place, size)
            if key in found or key in passed:
                self.refuse(place, f"has the key {shorten(key)} twice in a map", "each key once")
            inside = tuple(path[len(key) + 1 :] for path in skip if path == key or path.startswith(f"{key}."))
            if "" in inside:
                passed.add(key)
                self._pass()
            else:
                found[key] = self.value(inside, depth)
        return self._joined(at, found) if _CHUNKED in found else found

    def _pass(self) -> None:
        """Go to the end of the next value and build nothing."""
        waiting = 1
        while waiting:
            waiting -= 1
            kind, value = self._head()
            if kind in ("list", "map"):
                waiting += value * (2 if kind == "map" else 1)
            elif kind != "value":
                self._take(value + (kind == "extension"))

    # -- bytes -------------------------------------------------------------------------------------------------
    def _take(self, size: int) -> memoryview:
        piece = self._view[self.at : self.at + size]
        if len(piece) < size:
            self.refuse(self.at, f"ends after {len(piece):,} bytes", f"{size:,} or more")
        self.at += size
        return piece

    def _number(self, layout: str) -> Any:
        return struct.unpack(layout, self._take(struct.calcsize(layout)))[0]

    def _head(self) -> tuple[str, Any]:
        """Return a "value" without a size, or the kind and the size of what follows, for which there are bytes."""
        at = self.at
        code = self._take(1)[0]
        if code < 0x80 or code >= 0xE0:
            return "value", code if code < 0x80 else code - 256
        if code in _CONSTANTS:
            return "value", _CONSTANTS[code]
        if code in _NUMBERS:
            return "value", self._number(_NUMBERS[code])
        if code not in _SIZED:
            self.refuse(at, f"has the byte {code:02x}", "a value of MessagePack")
        kind, size = _SIZED[code]
        if isinstance(size, str):
            size = self._number(size)
        need, remain = size * (2 if kind == "map" else 1), len(self._view) - self.at
        if need > remain:
            what = {"map": f"{size:,} pairs", "list": f"{size:,} values"}.get(kind, f"{size:,} bytes")
            self.refuse(at, f"declares {what}", f"what fits into the {remain:,} bytes that remain")
        return kind, size

    def _text(self, at: int, size: int) -> str:
        try:
            return str(self._take(size), "utf-8")
        except UnicodeDecodeError:
            self.refuse(at, "has text that is not UTF-8", "UTF-8")

    # -- flax's arrays -----------------------------------------------------------------------------------------
    def _extension(self, at: int, size: int) -> Any:
        kind = self._number(">b")
        if kind not in (1, 3) or self._within:
            place = " inside of an extension" if self._within else ""
            self.refuse(at, f"has an extension of type {kind}{place}", "1 (an array) or 3 (a number), as flax writes")
        begin, end = self.at, self.at + len(self._take(size))
        inner = _Reader(self._view[:end], self._name, begin, within=True)
        match inner.value():
            case [list() as shape, str(dtype), memoryview() as data] if inner.at == end:
                array = self._array(at, shape, dtype, data)
            case _:
                self.refuse(at, "has an array of another form", "[shape, dtype, bytes], as flax writes")
        if kind == 1:
            return array
        if array.shape:
            self.refuse(at, f"has a number of shape {array.shape}", "()")
        return array.item()

    def _array(self, at: int, shape: list[Any], name: str, data: memoryview) -> npt.NDArray[Any]:
        if name not in _DTYPES:
            self.refuse(at, f"has an array of dtype {name!r:.40}", ", ".join(_DTYPES))
        dtype = np.dtype(_DTYPES[name])
        count = self._count(at, shape)
        if len(data) != count * dtype.itemsize:
            found = f"has an array of {len(data):,} bytes"
            self.refuse(at, found, f"{count * dtype.itemsize:,} for shape {tuple(shape)} of {name}")
        array = np.frombuffer(data, dtype).reshape(shape)
        if name == "bfloat16":
            memory.hold(self._name, 8 * count)
            return (array.astype(np.uint32) << 16).view(np.float32)
        if name == "bool":
            memory.hold(self._name, count)
            return np.asarray(array.view(np.uint8) != 0)  # bytes other than 0 and 1 would be undefined as bool
        return array.astype(dtype.newbyteorder("="), copy=False)

    def _count(self, at: int, shape: Any) -> int:
        """The number of values in an array of this shape, which the file declares."""
        edges = [edge for edge in shape if type(edge) is int and 0 < edge < 1 << 48]
        if len(edges) < len(shape) or len(edges) > MAX_DIMENSIONS:
            self.refuse(at, "has an invalid shape", f"at most {MAX_DIMENSIONS} edges of 1 or more")
        return math.prod(edges)

    def _joined(self, at: int, found: dict[str, Any]) -> npt.NDArray[Any]:
        """Join the chunks of an array."""
        shape, chunks = (self._numbered(at, found, key) for key in ("shape", "chunks"))
        kinds = {chunk.dtype if isinstance(chunk, np.ndarray) and chunk.ndim == 1 else None for chunk in chunks}
        if len(kinds) != 1 or None in kinds:
            self.refuse(at, "has chunks that are not flat arrays of one dtype", "chunks as flax writes them")
        count, total = self._count(at, shape), sum(map(len, chunks))
        if total != count:
            self.refuse(at, f"has chunks of {total:,} numbers", f"{count:,} for shape {tuple(shape)}")
        memory.hold(self._name, sum(chunk.nbytes for chunk in chunks))
        return np.concatenate(chunks).reshape(shape)

    def _numbered(self, at: int, found: dict[str, Any], key: str) -> list[Any]:
        """The values of a map whose keys are "0", "1" and so on."""
        values = found.get(key)
        if not isinstance(values, dict) or values.keys() != {str(i) for i in range(len(values))}:
            self.refuse(at, f"has {key_place(_CHUNKED, key)} of another form", 'a map with the keys "0", "1", ...')
        return [values[str(i)] for i in range(len(values))]
