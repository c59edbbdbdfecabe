"""The octree as a FlatBuffers table (.svo.fb); schema: schemas/svo.fbs.

    report   node_children [int], node_data [float]: float16 values are widened, FlatBuffers has no half
    bulk     children_blob, data_blob: dtype, shape and bytes; float16 stays float16

Arrays are handed over as they stand in memory, and a file's arrays are views of it, in both profiles.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nerfbake.formats.octree.fields import (
    MAX_2GIB,
    SMALL_SIZE,
    NoChild,
    Profile,
    children_with,
    octree_of,
    require_size,
    small_fields,
)
from nerfbake.formats.octree.type_urls import VoxelType
from nerfbake.formats.wire.blob import array_fields, blob_in
from nerfbake.formats.wire.flatbuffers import Field, Table, write_table
from nerfbake.scene.octree import SparseVoxelOctree

IDENTIFIER = b"SVO1"


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a file with the schema's identifier."""
    return bytes(view[4:8]) == IDENTIFIER


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "bulk",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """The file in pieces. Raises InvalidScene above FlatBuffers' 2 GiB."""
    widened = 4 if profile == "report" else octree.node_data.itemsize
    size = octree.node_children.nbytes + octree.node_data.size * widened + SMALL_SIZE
    require_size("svo.fb", size, MAX_2GIB, "FlatBuffers' limit")
    small = small_fields(octree, voxel_type)
    children, data = children_with(octree.node_children, no_child), octree.node_data
    report = profile == "report"
    fields: list[Field] = [
        small["type_url"],
        *octree.size,
        children if report else None,
        data.astype(np.float32, copy=False) if report else None,
        octree.data_format or None,
        octree.data_dim,
        np.array(octree.level_sizes, np.int32),
        octree.origin,
        octree.voxel_size,
        octree.extra_data,
        None if report else array_fields(children),
        None if report else array_fields(data),
    ]
    yield from write_table(fields, IDENTIFIER)


def decode(view: memoryview) -> SparseVoxelOctree:
    """The octree of either profile, its arrays views of the file."""
    root = Table.root(view)
    return octree_of(
        {
            "type_url": root.text(0),
            "width": root.number(1),
            "height": root.number(2),
            "depth": root.number(3),
            "node_children": blob_in(root.table(12)) or root.array(4, "<i4"),
            "node_data": blob_in(root.table(13)) or root.array(5, "<f4"),
            "data_format": root.text(6),
            "data_dim": root.number(7),
            "level_sizes": root.array(8, "<i4"),
            "origin": root.array(9, "<f8"),
            "voxel_size": root.array(10, "<f8"),
            "extra_data": root.array(11, "<f4"),
        }
    )
