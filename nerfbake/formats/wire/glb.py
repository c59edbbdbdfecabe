"""A .glb file taken apart: its JSON, looked into with care, and its accessors as arrays.

    12 B header: "glTF", 2, total size | JSON chunk: size, "JSON", text | BIN chunk, if any: size, "BIN\\0", data

Source: glTF 2.0, sections 3.6 and 4.4.
"""

from __future__ import annotations

import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import parse_object

_COPIES = 44  # bytes for each number of an accessor, while it is turned into a mesh's
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def malformed(place: str, found: str, allowed: str) -> InvalidFile:
    return InvalidFile(Problem(place, found, allowed))


class Document:
    """Its parts are looked up and checked as they are asked for."""

    def __init__(self, view: memoryview) -> None:
        json_chunk, self._bin = _chunks(view)
        self.root = parse_object(json_chunk, "the JSON chunk")

    def item(self, name: str, index: Any) -> dict[str, Any]:
        """root[name][index], an object."""
        entries = self.root.get(name)
        if not isinstance(entries, list):
            entries = []
        if type(index) is not int or not 0 <= index < len(entries):
            raise malformed(name, f"have no entry {str(index)[:40]}", f"one of {len(entries):,}")
        entry = entries[index]
        if not isinstance(entry, dict):
            raise malformed(f"{name}[{index}]", f"is a {type(entry).__name__}", "an object")
        return entry

    def accessor(self, index: Any, kinds: tuple[str, ...]) -> npt.NDArray[Any]:
        """(count, columns) of a type among `kinds`; whole numbers stay so unless they are normalised."""
        place, entry = f"accessors[{index}]", self.item("accessors", index)
        kind, component = entry.get("type"), entry.get("componentType")
        dtype = _DTYPES.get(component) if type(component) is int else None
        if kind not in kinds or dtype is None:
            found = f"is {str(kind)[:40]} of {str(component)[:40]}"
            raise malformed(place, found, f"{' or '.join(kinds)} of 5120 to 5126")
        if "sparse" in entry or "bufferView" not in entry:
            raise malformed(place, "is sparse or without a bufferView", "plain accessors")
        count, columns, item = whole(entry, "count", place), _COLUMNS[kind], np.dtype(dtype).itemsize
        view = self.item("bufferViews", entry["bufferView"])
        body = self.view(entry["bufferView"])
        stride, start = whole(view, "byteStride", place, columns * item), whole(entry, "byteOffset", place, 0)
        end = start + (count - 1) * stride + columns * item
        if not count or stride < columns * item or end > len(body):
            found = f"has {count:,} entries, up to byte {end:,}"
            raise malformed(place, found, f"1 or more, within the {len(body):,} bytes of its bufferView")
        memory.hold(place, _COPIES * count * columns)
        array = np.ndarray((count, columns), dtype, body, start, (stride, item))
        if entry.get("normalized") and dtype != "<f4":
            return np.maximum(array.astype(np.float64) / np.iinfo(dtype).max, -1)
        return array

    def view(self, index: Any) -> memoryview:
        """The bytes of a bufferView."""
        place, entry = f"bufferViews[{index}]", self.item("bufferViews", index)
        if "uri" in self.item("buffers", entry.get("buffer")) or entry.get("buffer") != 0:
            raise malformed(place, "is in another file", "the .glb's own binary chunk")
        start, size = whole(entry, "byteOffset", place, 0), whole(entry, "byteLength", place)
        if start + size > len(self._bin):
            raise malformed(
                place, f"ends at byte {start + size:,}", f"the {len(self._bin):,} bytes of the binary chunk"
            )
        return self._bin[start : start + size]


def whole(entry: dict[str, Any], key: str, place: str, default: int | None = None) -> int:
    """A whole number from 0."""
    value = entry.get(key, default)
    if type(value) is not int or not 0 <= value < 1 << 40:
        raise malformed(f"{place}.{key}", f"is {str(value)[:40]}", "a whole number from 0")
    return value


def _chunks(view: memoryview) -> tuple[memoryview, memoryview]:
    if len(view) < 20 or bytes(view[:4]) != b"glTF":
        raise malformed("file", "is no .glb", "one whole binary glTF 2.0 file")
    version, size, json_size, kind = struct.unpack_from("<III4s", view, 4)
    if version != 2 or kind != b"JSON":
        raise malformed("header", f"has version {version}, first chunk {kind!r}", "version 2, first chunk JSON")
    if size > len(view) or 20 + json_size > size:
        raise malformed("header", f"declares {max(size, 20 + json_size):,} bytes", f"the file's {len(view):,}")
    rest = view[20 + json_size : size]
    if len(rest) < 8:
        return view[20 : 20 + json_size], rest[:0]
    body_size, kind = struct.unpack_from("<I4s", rest)
    if kind != b"BIN\0" or 8 + body_size > len(rest):
        raise malformed("second chunk", f"is {kind!r} of {body_size:,} bytes", f"BIN, within {len(rest) - 8:,} bytes")
    return view[20 : 20 + json_size], rest[8 : 8 + body_size]
