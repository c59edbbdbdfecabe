"""The octree as the Protocol Buffers message of TR-24-01's listing 3 (docs/sources.md): .svo.pb, schemas/svo.proto.

These bytes are the same as the protobuf library's (a test compares them); the node values are handed over as they
stand in memory or are made, and a file's node values are read as a view of the file.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.octree.fields import (
    MAX_2GIB,
    SMALL_SIZE,
    NoChild,
    Profile,
    children_with,
    octree_of,
    require_size,
)
from nerfbake.formats.octree.type_urls import VoxelType, stored_dtype, type_url_of
from nerfbake.formats.wire.blob import Blob, blob_of, row_pieces
from nerfbake.formats.wire.protobuf import Message, bytes_field, bytes_head, floats_in, number_field
from nerfbake.kernels.coding.varint import encode_varints, varint_sizes
from nerfbake.kernels.parallel import ahead
from nerfbake.scene.octree import SparseVoxelOctree

_CHUNK = 1 << 18


def recognise(view: memoryview) -> bool:
    """True for the first bytes of the message: a type_url, as every known writer gives one."""
    head = bytes(view[:HEAD])
    return head[:1] == b"\x0a" and b"type.googleapis.com/" in head[:64]


def encode(
    octree: SparseVoxelOctree,
    *,
    no_child: NoChild = 0,
    profile: Profile = "report",
    voxel_type: VoxelType = "number",
) -> Iterator[bytes | memoryview]:
    """The message in pieces, fields in the order of their numbers. Raises InvalidScene above protobuf's 2 GiB.

    report: listing 3 field for field, children as varints. bulk: the children as they stand in memory, in a field of
    their own, which a reader of listing 3 alone does not know.
    """
    flat = octree.node_children.reshape(-1)
    chunks = [flat[start : start + _CHUNK] for start in range(0, len(flat), _CHUNK)]
    sizes = (varint_sizes(children_with(chunk, no_child)) for chunk in chunks)
    children_size = sum(sizes) if profile == "report" else flat.nbytes
    require_size("svo.pb", children_size + octree.node_rows.nbytes + SMALL_SIZE, MAX_2GIB, "protobuf's limit")
    yield bytes_field(1, type_url_of(octree, voxel_type).encode())
    for number, edge in enumerate(octree.size, start=2):
        yield number_field(number, edge)
    if children_size and profile == "report":
        yield bytes_head(5, children_size)
        yield from ahead(encode_varints(children_with(chunk, no_child)) for chunk in chunks)
    yield bytes_head(6, octree.node_rows.nbytes)
    yield from row_pieces(octree.node_rows)
    if octree.data_format:
        yield bytes_field(7, octree.data_format.encode())
    yield number_field(8, octree.data_dim)
    yield bytes_field(9, encode_varints(np.array(octree.level_sizes, np.int32)))
    yield bytes_field(10, octree.origin.astype("<f8").tobytes())
    yield bytes_field(11, octree.voxel_size.astype("<f8").tobytes())
    if octree.extra_data is not None:
        yield bytes_field(12, octree.extra_data.astype("<f4").tobytes())
    if children_size and profile == "bulk":
        yield bytes_head(13, children_size)
        yield blob_of(children_with(octree.node_children, no_child)).data


def decode(view: memoryview) -> SparseVoxelOctree:
    """The octree of a message. Fields 7 and up may be absent: the report's own files have none of them."""
    message = Message(view)
    children: Any = message.whole_numbers(5, "node_children")
    if len(bulk := message.last(13)):
        if len(children):
            raise InvalidFile(Problem("message", "has fields 5 and 13", "the children once"))
        children = Blob("<i4", (len(bulk) // 32, 8), bulk)
    return octree_of(
        {
            "type_url": message.text(1),
            "width": message.number(2),
            "height": message.number(3),
            "depth": message.number(4),
            "node_children": children,
            "node_data": floats_in(message.last(6), "node_data", stored_dtype(message.text(1)).str),
            "data_format": message.text(7),
            "data_dim": message.number(8),
            "level_sizes": message.whole_numbers(9, "level_sizes"),
            "origin": message.floats(10, "origin", "<f8"),
            "voxel_size": message.floats(11, "voxel_size", "<f8"),
            "extra_data": message.floats(12, "extra_data", "<f4"),
        }
    )
