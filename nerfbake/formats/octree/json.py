"""Read and write octrees as JSON (.svo.json): one object with the field names of schemas/svo.proto.

    report   {..., "node_children": [1, 2, 0, ...], "node_data": [0.25, ...]}
    bulk     {..., "node_children": {"dtype": "<i4", "shape": [c, 8], "data": "<base64>"}, "node_data": {...}}

A number has the fewest digits that give the same float when parsed. JSON cannot represent NaN and infinity.
"""

from __future__ import annotations

from binascii import Error as Base64Error
from binascii import a2b_base64, b2a_base64
from codecs import BOM_UTF8
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import orjson

from nerfbake import memory
from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.octree.fields import (
    NoChild,
    Profile,
    VoxelType,
    children_with,
    octree_from_fields,
    require_finite,
    small_fields,
)
from nerfbake.formats.wire.blob import Blob, blob_of
from nerfbake.formats.wire.json import parse_object
from nerfbake.scene.octree import SparseVoxelOctree

_CHUNK = 3 << 17  # numbers, or bytes: base64 needs a multiple of 3
# Written with the fewest digits, this float32 is read wrongly through a double, because it is rounded twice. It is the
# only such value: all 2^31 finite positive ones were tried.
_ROUNDED_TWICE = np.float32(7.038531e-26)


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a JSON object with the fields of an octree."""
    head = bytes(view[:HEAD]).removeprefix(BOM_UTF8)
    return head.lstrip()[:1] == b"{" and any(
        name in head for name in (b'"type_url"', b'"node_children"', b'"node_data"')
    )


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "bulk",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """Yield the object in pieces. Raises InvalidScene for NaN or infinity in a field that is written as numbers."""
    require_finite(octree, "svo.json", node_data=profile == "report")
    pieces = _list if profile == "report" else _blob
    yield orjson.dumps(small_fields(octree, voxel_type))[:-1]
    yield b',"node_children":'
    yield from pieces(children_with(octree.node_children, no_child))
    yield b',"node_data":'
    yield from pieces(octree.node_data)
    yield b"}\n"


def decode(view: memoryview) -> SparseVoxelOctree:
    """Read an octree of either profile."""
    fields = parse_object(view, "the JSON")
    for name in ("node_children", "node_data"):
        if isinstance(fields.get(name), dict):
            fields[name] = _read_blob(name, fields[name])
    return octree_from_fields(fields)


def _list(values: npt.NDArray[Any]) -> Iterator[bytes | memoryview]:
    flat = np.ascontiguousarray(values).reshape(-1)
    yield b"["
    for start in range(0, len(flat), _CHUNK):
        part = flat[start : start + _CHUNK]
        if (np.abs(part) == _ROUNDED_TWICE).any():
            part = part.astype(np.float64)
        text = orjson.dumps(part, option=orjson.OPT_SERIALIZE_NUMPY)
        yield b"," if start else b""
        yield memoryview(text)[1:-1]
    yield b"]"


def _blob(values: npt.NDArray[Any]) -> Iterator[bytes | memoryview]:
    blob = blob_of(values)
    yield orjson.dumps({"dtype": blob.dtype, "shape": blob.shape})[:-1] + b',"data":"'
    for start in range(0, len(blob.data), _CHUNK):
        yield b2a_base64(blob.data[start : start + _CHUNK], newline=False)
    yield b'"}'


def _read_blob(name: str, blob: dict[str, Any]) -> Blob:
    dtype, shape, text = blob.get("dtype"), blob.get("shape"), blob.get("data")
    whole = isinstance(shape, list) and all(type(edge) is int for edge in shape)
    if not (isinstance(dtype, str) and whole and isinstance(text, str)):
        raise InvalidFile(Problem(name, "is not a blob", "dtype as text, shape as whole numbers, data as base64"))
    memory.hold(name, len(text) * 3 // 4)
    try:
        return Blob(dtype, tuple(shape or ()), memoryview(a2b_base64(text, strict_mode=True)))
    except (Base64Error, ValueError) as error:
        raise InvalidFile(Problem(name, f"has data that is not base64 ({error})", "RFC 4648, no breaks")) from None
