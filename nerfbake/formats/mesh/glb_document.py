"""The container of .glb files: chunks, and the parts that the JSON refers to, each checked when it is accessed.

Accessors may be sparse, and are zeros without a bufferView. Buffers and pictures may be data URIs. BufferViews of
KHR_meshopt_compression and EXT_meshopt_compression are decompressed.

Source: glTF 2.0, sections 3.6 and 4.4.
"""

from __future__ import annotations

import base64
import struct
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.json import kind_of, parse_object
from nerfbake.formats.wire.meshopt import FILTERS, decompress
from nerfbake.kernels.arrays import Floats

MESHOPT = ("KHR_meshopt_compression", "EXT_meshopt_compression")
_VERSION = "2.0"
_COPIES = 44  # bytes of memory for each number of an accessor, while it is converted to mesh data
_PADDING = 3  # bytes at most behind the JSON
_ZEROS = 1 << 24  # numbers of an accessor without data: a few bytes of JSON may declare any number of them
_DTYPES = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_COLUMNS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def malformed(place: str, found: str, allowed: str) -> InvalidFile:
    return InvalidFile(Problem(place, found, allowed))


class Document:
    """The parts of a .glb file. Each part is checked when it is accessed."""

    def __init__(self, view: memoryview) -> None:
        json_chunk, self._bin = _chunks(view)
        last = bytes(json_chunk[-_PADDING:])  # some exporters pad with zeros, instead of spaces
        text = json_chunk[: len(json_chunk) - len(last) + len(last.rstrip(b"\0"))]
        self.root = parse_object(text, "the JSON chunk")
        self._inlined: dict[int, memoryview] = {}  # buffers in data URIs
        self._unpacked: dict[int, memoryview] = {}  # compressed bufferViews
        asset = self.root.get("asset")
        for key in ("version", "minVersion"):
            found = str(asset.get(key, _VERSION))[:40] if isinstance(asset, dict) else _VERSION
            if found != _VERSION and (key == "minVersion" or not found.startswith("2.")):
                raise malformed(f"asset.{key}", f"is {found}", _VERSION)

    def item(self, name: str, index: Any) -> dict[str, Any]:
        """Return root[name][index], which must be an object."""
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
        """Return an accessor whose type is among `kinds`, (count, columns). Normalised integers become floats."""
        place, entry = f"accessors[{index}]", self.item("accessors", index)
        kind, component = entry.get("type"), entry.get("componentType")
        dtype = _DTYPES.get(component) if type(component) is int else None
        if kind not in kinds or dtype is None:
            found = f"is {str(kind)[:40]} of {str(component)[:40]}"
            raise malformed(place, found, f"{' or '.join(kinds)} of 5120 to 5126")
        count, columns = whole(entry, "count", place), _COLUMNS[kind]
        array: npt.NDArray[Any]
        if "bufferView" in entry:
            array = self._items(entry, place, count, columns, dtype, strided=True)
            memory.hold(place, _COPIES * count * columns)
        elif 0 < count * columns <= _ZEROS:
            memory.hold(place, _COPIES * count * columns)
            array = np.zeros((count, columns), dtype)
        else:
            found = f"has {count:,} entries without a bufferView"
            raise malformed(place, found, f"1 to {_ZEROS // columns:,}, which are zeros")
        if "sparse" in entry:
            array = self._replaced(array, entry["sparse"], f"{place}.sparse")
        if entry.get("normalized") and dtype != "<f4":
            return np.maximum(array.astype(np.float64) / np.iinfo(dtype).max, -1)
        return array

    def _items(
        self, entry: dict[str, Any], place: str, count: int, columns: int, dtype: str, *, strided: bool = False
    ) -> npt.NDArray[Any]:
        """Return the numbers that a part of an accessor refers to, (count, columns)."""
        item = np.dtype(dtype).itemsize
        view = self.item("bufferViews", entry.get("bufferView"))
        body = self.view(entry["bufferView"])
        stride, start = columns * item, whole(entry, "byteOffset", place, 0)
        if strided:
            stride = whole(view, "byteStride", place, stride)
        end = start + (count - 1) * stride + columns * item
        if not count or stride < columns * item or end > len(body):
            found = f"has {count:,} entries, up to byte {end:,}"
            raise malformed(place, found, f"1 or more, within the {len(body):,} bytes of its bufferView")
        return np.ndarray((count, columns), dtype, body, start, (stride, item))

    def _replaced(self, array: npt.NDArray[Any], sparse: Any, place: str) -> npt.NDArray[Any]:
        """Return a copy of an accessor with the entries that `sparse` replaces."""
        if not isinstance(sparse, dict):
            raise malformed(place, f"is {kind_of(sparse)}", "an object")
        count, indices, values = whole(sparse, "count", place), sparse.get("indices"), sparse.get("values")
        component = indices.get("componentType") if isinstance(indices, dict) else None
        if not (isinstance(indices, dict) and isinstance(values, dict) and component in (5121, 5123, 5125)):
            raise malformed(place, "has no indices or values", "indices of 5121, 5123 or 5125, and values")
        rows = self._items(indices, f"{place}.indices", count, 1, _DTYPES[component])[:, 0]
        new = self._items(values, f"{place}.values", count, array.shape[1], array.dtype.str)
        if rows.max() >= len(array):
            raise malformed(f"{place}.indices", f"go to {rows.max():,}", f"0 to {len(array) - 1:,}")
        found = array.copy()
        found[rows] = new
        return found

    def view(self, index: Any) -> memoryview:
        """Return the bytes of a bufferView, decompressed."""
        place, entry = f"bufferViews[{index}]", self.item("bufferViews", index)
        for name in MESHOPT:
            if (packed := extension_of(entry, name, place)) is not None:
                return self._unpacked_view(index, packed, f"{place}.{name}")
        return self._part(entry, place)

    def _unpacked_view(self, index: int, packed: dict[str, Any], place: str) -> memoryview:
        if index not in self._unpacked:
            self._unpacked[index] = decompress(
                self._part(packed, place),
                count=whole(packed, "count", place),
                stride=whole(packed, "byteStride", place),
                mode=str(packed.get("mode")),
                filter_=str(packed.get("filter", FILTERS[0])),
                place=place,
            )
        return self._unpacked[index]

    def _part(self, entry: dict[str, Any], place: str) -> memoryview:
        """Return a part of a buffer."""
        number: Any = entry.get("buffer")
        buffer = self.item("buffers", number)
        if "uri" in buffer:
            if number not in self._inlined:
                self._inlined[number] = inline(buffer["uri"], place, "the binary chunk of the .glb")
                memory.hold(place, len(self._inlined[number]))
            body = self._inlined[number]
        elif number == 0:
            body = self._bin
        else:
            raise malformed(place, "is in another file", "the binary chunk of the .glb")
        start, size = whole(entry, "byteOffset", place, 0), whole(entry, "byteLength", place)
        if start + size > len(body):
            found = f"ends at byte {start + size:,}"
            raise malformed(place, found, f"the {len(body):,} bytes of the binary chunk")
        return body[start : start + size]


def inline(uri: Any, place: str, allowed: str) -> memoryview:
    """Return the bytes in a data URI: data:image/png;base64,... Raises InvalidFile for a file elsewhere."""
    head, comma, text = uri.partition(",") if isinstance(uri, str) else ("", "", "")
    if not (head.startswith("data:") and head.endswith(";base64") and comma):
        raise malformed(place, "is in another file", allowed)
    memory.require(place, len(text))
    try:
        return memoryview(base64.b64decode(text, validate=True))
    except ValueError:
        raise malformed(place, "has a data URI that is damaged", "base64") from None


def whole(entry: dict[str, Any], key: str, place: str, default: int | None = None) -> int:
    """Return a whole number, 0 or more."""
    value = entry.get(key, default)
    if type(value) is not int or not 0 <= value < 1 << 40:
        raise malformed(f"{place}.{key}", f"is {str(value)[:40]}", "a whole number, 0 or more")
    return value


def _chunks(view: memoryview) -> tuple[memoryview, memoryview]:
    if len(view) < 20 or bytes(view[:4]) != b"glTF":
        raise malformed("file", "is not a .glb", "a complete binary glTF 2.0 file")
    version, size, json_size, kind = struct.unpack_from("<III4s", view, 4)
    if version != 2 or kind != b"JSON":
        raise malformed("header", f"has version {version}, first chunk {kind!r}", "version 2, first chunk JSON")
    if size > len(view) or 20 + json_size > size:
        raise malformed("header", f"declares {max(size, 20 + json_size):,} bytes", f"the file's {len(view):,}")
    rest = view[20 + json_size : size]
    if len(rest) < 8:
        return view[20 : 20 + json_size], rest[:0]
    body_size, kind = struct.unpack_from("<I4s", rest)
    if kind != b"BIN\0" and 8 + body_size <= len(rest):
        return view[20 : 20 + json_size], rest[:0]  # a kind of chunk that readers must ignore
    if kind != b"BIN\0" or 8 + body_size > len(rest):
        raise malformed("second chunk", f"is {kind!r} of {body_size:,} bytes", f"BIN, within {len(rest) - 8:,} bytes")
    return view[20 : 20 + json_size], rest[8 : 8 + body_size]


def extension_of(entry: dict[str, Any], name: str, place: str) -> dict[str, Any] | None:
    extensions = entry.get("extensions")
    found = extensions.get(name) if isinstance(extensions, dict) else None
    if found is not None and not isinstance(found, dict):
        raise malformed(f"{place}.extensions.{name}", f"is {kind_of(found)}", "an object")
    return found


def numbers_of(entry: dict[str, Any], key: str, place: str, *default: float) -> Floats:
    """Return a list of as many numbers as the default has. Parsed JSON holds no others than finite ones."""
    values = entry.get(key, default)
    if (
        not isinstance(values, list | tuple)
        or len(values) != len(default)
        or not all(type(value) in (int, float) for value in values)
    ):
        raise malformed(f"{place}.{key}", "is not a list of numbers", f"{len(default)} finite numbers")
    return np.array(values, np.float64)


def list_of(entry: dict[str, Any], key: str, place: str) -> list[Any]:
    found = entry.get(key, [])
    if not isinstance(found, list):
        raise malformed(f"{place}.{key}", f"is a {type(found).__name__}", "a list")
    return found
