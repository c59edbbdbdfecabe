"""The octree as one BSON document (.svo.bson): the same names as in schemas/svo.proto.

    report   node_children an array of int32, node_data an array of doubles
    bulk     each a document {dtype, shape, data: binary}, the binary being the array as it stands in memory

A test holds the bytes to be the same as those of pymongo's bson.
"""

from __future__ import annotations

from collections.abc import Iterator

from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.octree.fields import (
    MAX_2GIB,
    NoChild,
    Profile,
    children_with,
    octree_of,
    require_size,
    small_fields,
)
from nerfbake.formats.octree.type_urls import VoxelType
from nerfbake.formats.wire.bson import (
    ARRAY,
    DOCUMENT,
    DOUBLE,
    INT32,
    Large,
    blob_in,
    document_head,
    numbers_in,
    split_document,
    starts_document,
)
from nerfbake.scene.octree import SparseVoxelOctree


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a document with the octree's fields."""
    head = bytes(view[:HEAD])
    return starts_document(head) and b"type_url\0" in head


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "bulk",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """The document in pieces. Raises InvalidScene above BSON's 2 GiB."""
    children = Large.of("node_children", octree.node_children, INT32, blob=profile == "bulk")
    data = Large.of("node_data", octree.node_data, DOUBLE, blob=profile == "bulk")
    size, head = document_head(small_fields(octree, voxel_type), children, data)
    require_size("svo.bson", size, MAX_2GIB, "BSON's limit")
    yield head
    yield from children.pieces(children_with(octree.node_children, no_child))
    yield from data.pieces(octree.node_data)
    yield b"\0"


def decode(view: memoryview) -> SparseVoxelOctree:
    """The octree of either profile; blobs are views of the file."""
    fields, large = split_document(view, "document", ("node_children", "node_data"))
    for name, (kind, value) in large.items():
        if kind == ARRAY:
            fields[name] = numbers_in(value, name)
        elif kind == DOCUMENT:
            fields[name] = blob_in(value, name)
        else:
            raise InvalidFile(Problem(name, f"has BSON type {kind}", "an array of numbers, or dtype, shape and data"))
    return octree_of(fields)
