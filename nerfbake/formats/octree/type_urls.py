"""What a file's type_url says of a node's values: their number type, and the names of all of them if it is a voxel's.

    type.googleapis.com/google.protobuf.FloatValue      float32: the report's own
    type.googleapis.com/svo.protobuf.Float16Value       float16
    type.googleapis.com/svo.protobuf.SH9Voxel           float32, and a node is an SH9Voxel of schemas/voxels.proto
    type.googleapis.com/svo.protobuf.SH9HalfVoxel       float16, and the same

The values themselves stand in node_data as they always do. Source: TR-24-01 (docs/sources.md), 3.3 and 5.1.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np

from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.scene.basis import SH_SIZES
from nerfbake.scene.octree import SparseVoxelOctree

VoxelType = Literal["number", "struct"]

_HOME = "type.googleapis.com/"
TYPE_URLS = {"float32": f"{_HOME}google.protobuf.FloatValue", "float16": f"{_HOME}svo.protobuf.Float16Value"}
NAMED = ("RGBA", *(f"SH{size}" for size in SH_SIZES))  # data formats whose voxels have a message
_VOXELS = {
    f"{_HOME}svo.protobuf.{data_format}{half}Voxel": (dtype, data_format)
    for data_format in NAMED
    for half, dtype in (("", "<f4"), ("Half", "<f2"))
}
_MEANINGS = {TYPE_URLS["float32"]: ("<f4", ""), TYPE_URLS["float16"]: ("<f2", ""), **_VOXELS}


def type_url_of(octree: SparseVoxelOctree, voxel_type: VoxelType) -> str:
    """number: the type of a value. struct: the type of a node, which names all its values. Raises InvalidScene where
    there is no such type."""
    dtype = octree.node_rows.dtype
    if voxel_type == "number":
        return TYPE_URLS[dtype.name]
    if octree.data_format not in NAMED:
        found = f"is {octree.data_format!r}, whose voxels have no type of their own"
        raise InvalidScene(Problem("data_format", found, f"{', '.join(NAMED)}, or the voxel type 'number'"))
    return next(url for url, known in _VOXELS.items() if known == (dtype.newbyteorder("<").str, octree.data_format))


def stored_dtype(type_url: str) -> np.dtype[Any]:
    """The number type of node_data; float32 where the file says nothing. Raises InvalidFile for an unknown type."""
    return np.dtype(_meaning(type_url)[0])


def named_format(type_url: str, data_format: str) -> str:
    """The data format that a file states as such, or by the type of its voxels. Raises InvalidFile where it states two
    that differ."""
    named = _meaning(type_url)[1]
    if named and data_format and named != data_format:
        raise InvalidFile(
            Problem("type_url", f"names a voxel of {named}", f"one of {data_format[:40]}, as data_format says")
        )
    return named or data_format


def _meaning(type_url: str) -> tuple[str, str]:
    found = _MEANINGS.get(type_url or TYPE_URLS["float32"])
    if found is None:
        allowed = f"{' or '.join(TYPE_URLS.values())}, or a voxel of schemas/voxels.proto"
        raise InvalidFile(Problem("type_url", f"is {type_url[:80]!r}", allowed))
    return found
