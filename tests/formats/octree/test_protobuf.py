from __future__ import annotations

import ast
import importlib
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake import build_octree
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.octree import protobuf as octree_protobuf
from nerfbake.formats.octree.fields import TYPE_URLS
from nerfbake.kernels.coding.varint import encode_varints
from nerfbake.memory import memory_limit
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conftest import REPOSITORY
from tests.support.octrees import small_octree
from tests.support.scenes import assert_same_octree, n3tree, octrees
from tests.support.tools import SCHEMAS, protoc

# The own schema of TR-24-01 (docs/sources.md): what a reader that has never heard of nerfbake knows.
LISTING_3 = """
syntax = "proto3";
package listing3;
message SparseVoxelOctree {
  string type_url = 1; int32 width = 2; int32 height = 3; int32 depth = 4;
  repeated int32 node_children = 5 [packed = true];
  bytes node_data = 6;
}
"""


@pytest.fixture(scope="module")
def schemas(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The generated message classes of schemas/svo.proto and of the report's listing, compiled by protoc."""
    from grpc_tools import protoc

    folder = tmp_path_factory.mktemp("generated")
    (folder / "svo_ours.proto").write_text((REPOSITORY / "schemas" / "svo.proto").read_text())
    (folder / "svo_listing3.proto").write_text(LISTING_3)
    names = ("svo_ours", "svo_listing3")
    arguments = ["protoc", f"-I{folder}", f"--python_out={folder}", *(f"{name}.proto" for name in names)]
    assert protoc.main(arguments) == 0
    return {name: _import(folder, f"{name}_pb2").SparseVoxelOctree for name in names}


def _import(folder: Path, name: str) -> ModuleType:
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module(name)
    finally:
        sys.path.remove(str(folder))


def written(octree: SparseVoxelOctree, **options: Any) -> bytes:
    return b"".join(octree_protobuf.encode(octree, **options))


def read(data: bytes, limit: int = 1 << 24) -> SparseVoxelOctree:
    with memory_limit(limit):
        return octree_protobuf.decode(memoryview(data))


@given(octrees(), st.sampled_from([0, -1]))
def test_round_trips_are_exact(octree: SparseVoxelOctree, no_child: int) -> None:
    data = written(octree, no_child=no_child)
    assert octree_protobuf.recognise(memoryview(data[:512]))
    assert_same_octree(read(data), replace(octree, data_format=read(data).data_format))
    assert written(octree, no_child=no_child) == data


@given(octree=octrees(), no_child=st.sampled_from([0, -1]))
def test_the_bytes_are_the_ones_that_protobuf_writes(
    schemas: dict[str, Any], octree: SparseVoxelOctree, no_child: int
) -> None:
    message = schemas["svo_ours"](
        type_url=TYPE_URLS[octree.node_data.dtype.name],
        width=octree.size[0],
        height=octree.size[1],
        depth=octree.size[2],
        node_children=np.where(octree.node_children == 0, no_child, octree.node_children).ravel().tolist(),
        node_data=octree.node_data.tobytes(),
        data_format=octree.data_format,
        data_dim=octree.data_dim,
        level_sizes=octree.level_sizes,
        origin=octree.origin,
        voxel_size=octree.voxel_size,
        extra_data=[] if octree.extra_data is None else octree.extra_data.ravel(),
    )
    assert written(octree, no_child=no_child) == message.SerializeToString(deterministic=True)


@given(octree=octrees(), no_child=st.sampled_from([0, -1]))
def test_the_bulk_profile_is_what_protobuf_writes(
    schemas: dict[str, Any], octree: SparseVoxelOctree, no_child: int
) -> None:
    data = written(octree, no_child=no_child, profile="bulk")
    message = schemas["svo_ours"].FromString(data)
    assert not message.node_children
    children = np.frombuffer(message.node_children_bulk, "<i4").reshape(-1, 8)
    assert_array_equal(np.where(children == -1, 0, children), octree.node_children)
    assert message.node_data == octree.node_data.tobytes()
    assert message.SerializeToString(deterministic=True) == data


@pytest.mark.parametrize("profile", ["report", "bulk"])
def test_protoc_decodes_both_profiles(profile: str) -> None:
    octree = small_octree()
    decode = ("--decode=svo.protobuf.SparseVoxelOctree", f"-I{SCHEMAS}", "svo.proto")
    fields: dict[str, list[str]] = {}
    for line in protoc(*decode, stdin=written(octree, profile=profile)).decode().splitlines():
        key, _, value = line.partition(": ")
        fields.setdefault(key, []).append(value)

    def unescaped(text: str) -> bytes:
        # Text format writes bytes as C does: octal escapes, and \\n, \\t, \\", \\'.
        return bytes(ast.literal_eval(f"b{text}"))

    assert [fields[key] for key in ("width", "height", "depth", "data_dim")] == [["4"], ["4"], ["4"], ["13"]]
    assert unescaped(fields["node_data"][0]) == octree.node_data.tobytes()
    if profile == "report":
        assert list(map(int, fields["node_children"])) == octree.node_children.ravel().tolist()
    else:
        assert unescaped(fields["node_children_bulk"][0]) == octree.node_children.tobytes()
    assert list(map(float, fields["voxel_size"])) == octree.voxel_size.tolist()


@given(octree=octrees(dtypes=[np.float32]))
def test_a_reader_of_listing_3_alone_gets_the_octree(schemas: dict[str, Any], octree: SparseVoxelOctree) -> None:
    full = octree.with_layout("full")
    message = schemas["svo_listing3"].FromString(written(full))
    assert message.type_url == "type.googleapis.com/google.protobuf.FloatValue"
    assert (message.width, message.height, message.depth) == full.size
    children = np.array(message.node_children).reshape(-1, 8)
    data = np.frombuffer(message.node_data, "<f4").reshape(len(children), -1)
    assert_array_equal(children, full.node_children)
    assert_array_equal(data, full.node_data)


def test_a_file_of_listing_3_alone_is_read(schemas: dict[str, Any]) -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))], data_format="SH4"))
    # As another program may write it: depth first, -1 for "no child", nothing that listing 3 cannot say.
    order = [0, 1, 2, 3, 4, 5, 6, 9, 10, 11, 12, 13, 14, 15, 16, 7, 8]
    rank = np.argsort(order)
    children = np.where(octree.node_children == 0, -1, rank[octree.node_children])[order]
    message = schemas["svo_listing3"](
        type_url="type.googleapis.com/google.protobuf.FloatValue",
        width=4,
        height=4,
        depth=4,
        node_children=children.ravel().tolist(),
        node_data=octree.node_data[order].tobytes(),
    )
    back = read(message.SerializeToString())
    assert_same_octree(back, replace(octree, origin=np.zeros(3), voxel_size=np.ones(3)))


def test_a_packed_array_may_come_in_pieces() -> None:
    octree = build_octree(n3tree())
    whole = written(octree)
    table = encode_varints(octree.node_children.reshape(-1))
    run = b"\x2a" + encode_varints(np.array([len(table)], np.int32)) + table
    assert run in whole
    pieces = b"\x2a\x08" + table[:8] + b"\x2a" + bytes([len(table) - 8]) + table[8:]
    assert_same_octree(read(whole.replace(run, pieces)), octree)


def test_zero_for_no_child_is_the_smaller_spelling() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))]))
    slots = int((octree.node_children == 0).sum())
    assert len(written(octree, no_child=-1)) - len(written(octree)) in range(9 * slots, 9 * slots + 3)


def test_more_than_two_gibibytes_are_refused_before_anything_is_written() -> None:
    octree = build_octree(n3tree())
    rows = 2**31 // octree.node_data[0].nbytes
    huge = replace(octree, node_data=np.broadcast_to(octree.node_data[:1], (rows, octree.data_dim)))
    with pytest.raises(InvalidScene, match=r"would take 2,148,\d+,\d+ bytes; allowed: 2,147,483,647"):
        next(octree_protobuf.encode(huge))


def test_children_count_against_max_memory() -> None:
    with pytest.raises(MemoryLimit, match="node_children needs"):
        read(written(build_octree(n3tree())), limit=64)


def field(number: int, wire: int, payload: bytes) -> bytes:
    return bytes([number << 3 | wire]) + payload


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (field(1, 2, b"\x7f"), "starts field 1"),
        (field(1, 3, b""), "has wire type 3"),
        (field(0, 0, b"\x01"), "starts field 0"),
        (b"\xff" * 11, "starts a varint that does not end"),
        (field(5, 2, b"\x03\x01\x02\x03"), "node_children has 3 numbers; allowed: a multiple of 8"),
        (field(5, 0, b"\x01"), "field 5 has wire type 0; allowed: 2"),
        (field(1, 2, b"\x01x"), "type_url is 'x'"),
        (field(1, 2, b"\x01\xff"), "field 1 is not UTF-8"),
        (field(1, 2, b"\x00"), "adds up to 0 nodes"),
        (field(9, 2, b"\x01\x05") + field(6, 2, b"\x03abc"), "node_data has 3 bytes; allowed: a multiple of 4"),
        (field(9, 2, b"\x01\x01") + field(6, 2, b"\x04abcd"), "size is 0x0x0"),
        (field(2, 0, b"\x01") * 10_001, "more than 10,000 fields"),
        (field(9, 2, b"\x01\x05") + field(6, 2, b"\x04abcd"), "level_sizes adds up to 5 nodes; allowed: 1 to 1"),
        (field(9, 2, b"\x01\x02") + field(6, 2, bytes([12, *bytes(12)])), "node_data has 3 values"),
        (field(5, 2, b"\x01\x00") + field(13, 2, b"\x01\x00"), "has fields 5 and 13"),
        (field(13, 2, b"\x01\x00"), "node_children declares shape"),
        (
            field(10, 2, b"\x01x") + field(9, 2, b"\x01\x01") + field(6, 2, b"\x04abcd"),
            "origin has 1 bytes; allowed: a multiple of 8",
        ),
    ],
)
def test_lies_are_refused(data: bytes, message: str) -> None:
    with pytest.raises((InvalidFile, InvalidScene), match=message):
        read(data)


def test_level_sizes_that_lie_are_refused() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))]))
    data = written(octree)
    sizes = field(9, 2, b"\x03\x01\x08\x08")
    assert sizes in data
    with pytest.raises(InvalidFile, match="level_sizes are"):
        read(data.replace(sizes, field(9, 2, b"\x03\x01\x07\x09")))
