"""The octree as a Cap'n Proto struct (.svo.capnp); schema: schemas/svo.capnp.

    report   nodeChildren List(Int32), nodeData List(Float32): float16 values are widened, Cap'n Proto has no half
    bulk     childrenBlob, dataBlob: dtype, shape and bytes; float16 stays float16; a blob has 512 MiB at most

Arrays are handed over as they stand in memory, and a file's arrays are views of it, in both profiles. Other readers
count what they visit: give them a traversal limit of the file's size, in words of 8 bytes.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

import numpy as np

from nerfbake.contract import HEAD
from nerfbake.formats.octree.fields import NoChild, Profile, children_with, octree_of, small_fields
from nerfbake.formats.octree.type_urls import VoxelType
from nerfbake.formats.wire.blob import array_fields, blob_in
from nerfbake.formats.wire.capnp import Field, Message, write_struct
from nerfbake.scene.octree import SparseVoxelOctree

_DATA_WORDS, _POINTERS = 2, 10  # of the schema's struct
_MAX_SECTION = 64


def recognise(view: memoryview) -> bool:
    """True for a segment table, then a pointer to a struct at least as large as the schema's."""
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
    """The message in pieces. Raises InvalidScene for an array that a Cap'n Proto list cannot count."""
    small = small_fields(octree, voxel_type)
    children, data = children_with(octree.node_children, no_child), octree.node_data
    report = profile == "report"
    fields: list[Field] = [
        small["type_url"],
        children if report else None,
        data.astype(np.float32, copy=False) if report else None,
        octree.data_format or None,
        np.array(octree.level_sizes, np.int32),
        octree.origin,
        octree.voxel_size,
        octree.extra_data,
        None if report else array_fields(children),
        None if report else array_fields(data),
    ]
    yield from write_struct([*octree.size, octree.data_dim], fields)


def decode(view: memoryview) -> SparseVoxelOctree:
    """The octree of either profile, its arrays views of the file."""
    root = Message(view).root
    return octree_of(
        {
            "type_url": root.text(0),
            "width": root.number(0),
            "height": root.number(1),
            "depth": root.number(2),
            "node_children": blob_in(root.struct(8)) or root.array(1, "<i4"),
            "node_data": blob_in(root.struct(9)) or root.array(2, "<f4"),
            "data_format": root.text(3),
            "data_dim": root.number(3),
            "level_sizes": root.array(4, "<i4"),
            "origin": root.array(5, "<f8"),
            "voxel_size": root.array(6, "<f8"),
            "extra_data": root.array(7, "<f4"),
        }
    )
