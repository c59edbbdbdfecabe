from __future__ import annotations

import json
import struct
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.octree import capnp as octree_capnp
from nerfbake.formats.octree import capnp as wire_capnp
from nerfbake.formats.octree.fields import TYPE_URLS
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.octrees import read, small_octree, written
from tests.support.scenes import assert_same_octree, octrees
from tests.support.tools import SCHEMAS, tool

capnp = pytest.importorskip("capnp")
SCHEMA = capnp.load(str(SCHEMAS / "svo.capnp")).SparseVoxelOctree


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_capnp_convert_reads_the_report_profile(dtype: type) -> None:
    octree = small_octree(dtype)
    data = written("svo.capnp", "report", octree)
    text = tool("capnp", "convert", "binary:json", SCHEMAS / "svo.capnp", "SparseVoxelOctree", stdin=data)
    document = json.loads(text)
    assert document["nodeChildren"] == octree.node_children.ravel().tolist()
    assert document["nodeData"] == octree.node_data.ravel().tolist()
    assert [document[key] for key in ("width", "height", "depth", "dataDim")] == [4, 4, 4, 13]
    assert document["levelSizes"] == octree.level_sizes
    assert document["dataFormat"] == "SH4"
    assert document["origin"] == octree.origin.tolist()
    assert document["voxelSize"] == octree.voxel_size.tolist()
    assert document["typeUrl"] == TYPE_URLS[octree.node_data.dtype.name]


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_capnp_convert_reads_the_bulk_profile(dtype: type) -> None:
    octree = small_octree(dtype)
    data = written("svo.capnp", "bulk", octree)
    text = tool("capnp", "convert", "binary:json", SCHEMAS / "svo.capnp", "SparseVoxelOctree", stdin=data)
    for name, values in (("childrenBlob", octree.node_children), ("dataBlob", octree.node_data)):
        blob = json.loads(text)[name]
        assert blob["dtype"] == values.dtype.str
        assert list(map(int, blob["shape"])) == list(values.shape)
        assert bytes(blob["data"]) == values.tobytes()


def test_capnp_decode_accepts_it() -> None:
    for profile in ("report", "bulk"):
        data = written("svo.capnp", profile, small_octree())
        assert b"width = 4" in tool("capnp", "decode", SCHEMAS / "svo.capnp", "SparseVoxelOctree", stdin=data)


@settings(max_examples=20)
@given(octrees())
def test_pycapnp_reads_both_profiles(octree: SparseVoxelOctree) -> None:
    data = written("svo.capnp", "report", octree)
    with SCHEMA.from_bytes(data, traversal_limit_in_words=len(data) // 8 + 64) as report:
        assert list(report.nodeChildren) == octree.node_children.ravel().tolist()
        assert_array_equal(np.array(report.nodeData, np.float32), octree.node_data.ravel().astype(np.float32))
        assert (report.width, report.height, report.depth) == octree.size
        assert list(report.levelSizes) == octree.level_sizes
    data = written("svo.capnp", "bulk", octree)
    with SCHEMA.from_bytes(data, traversal_limit_in_words=len(data) // 8 + 64) as bulk:
        assert bytes(bulk.dataBlob.data) == octree.node_data.tobytes()
        assert list(bulk.childrenBlob.shape) == list(octree.node_children.shape)


def by_pycapnp(octree: SparseVoxelOctree) -> Any:
    width, height, depth = octree.size
    return SCHEMA.new_message(
        typeUrl=TYPE_URLS[octree.node_data.dtype.name],
        width=width,
        height=height,
        depth=depth,
        nodeChildren=octree.node_children.ravel().tolist(),
        nodeData=octree.node_data.ravel().astype(np.float32).tolist(),
        dataFormat=octree.data_format,
        levelSizes=octree.level_sizes,
        origin=octree.origin.tolist(),
        voxelSize=octree.voxel_size.tolist(),
    )


@settings(max_examples=20)
@given(octrees())
def test_what_pycapnp_writes_is_read(octree: SparseVoxelOctree) -> None:
    octree = replace(octree, extra_data=None)
    data = by_pycapnp(octree).to_bytes()
    assert octree_capnp.recognise(memoryview(data[:512]))
    back = read("svo.capnp", data)
    assert_same_octree(back, replace(octree, data_format=octree.data_format or back.data_format))


def test_many_segments_and_far_pointers_are_read() -> None:
    values = np.random.default_rng(0).random((1, 5000), np.float32)
    octree = SparseVoxelOctree((1, 1, 1), np.zeros((1, 8), np.int32), values)
    data = by_pycapnp(octree).to_bytes()
    assert int.from_bytes(data[:4], "little") > 0
    assert_same_octree(read("svo.capnp", data), octree)


def test_double_far_pointers_are_read() -> None:
    """The content in segment 1, its landing pad in segment 2, as a full segment 1 makes writers do."""
    octree = small_octree()
    (segment,) = wire_capnp.CapnpMessage(memoryview(written("svo.capnp", "bulk", octree))).segments
    offset, description = struct.unpack("<iI", segment[:8])
    assert (offset, description) == (0, 2 | 10 << 16)
    first = struct.pack("<II", 2 | 1 << 2 | 0 << 3, 2)
    pad = struct.pack("<II", 2 | 1 << 3, 1) + struct.pack("<iI", 0, description)
    data = struct.pack("<4I", 2, 1, len(segment) // 8, 2) + first + bytes(segment) + pad
    assert_same_octree(read("svo.capnp", data), octree)


def test_an_array_that_no_list_can_count_is_refused_before_anything_is_written(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(SparseVoxelOctree, "level_sizes", [1])  # of a tree that is not there
    octree = small_octree()
    huge = replace(octree, node_data=np.broadcast_to(octree.node_data[:1], (2**29 // 13 + 1, 13)))
    with pytest.raises(
        InvalidScene, match=r"svo\.capnp would need a list of 536,870,\d+ elements; allowed: 536,870,911"
    ):
        next(octree_capnp.encode(huge, profile="report"))
    huge = replace(octree, node_data=huge.node_data[: 2**29 // 52 + 1])
    with pytest.raises(InvalidScene, match=r"536,870,\d+ elements; allowed: 536,870,911.*`profile=report`"):
        next(octree_capnp.encode(huge, profile="bulk"))


BULK, REPORT = (written("svo.capnp", profile, small_octree()) for profile in ("bulk", "report"))
ROOT, POINTERS = 8, 8 + 8 + 16  # the root pointer, and the struct's pointers


SHAPE = struct.pack("<2Q", 17, 13)


def patched(data: bytes, at: int, kind: str, *values: int) -> bytes:
    broken = bytearray(data)
    struct.pack_into(kind, broken, at, *values)
    return bytes(broken)


def pointer(index: int) -> int:
    return POINTERS + 8 * index


def first(data: bytes, index: int) -> int:
    """Where what a pointer of the root points to starts."""
    return int(pointer(index) + 8 + 8 * (struct.unpack_from("<i", data, pointer(index))[0] >> 2))


LIES: dict[str, tuple[bytes, str]] = {
    "three bytes": (BULK[:3], "segment table"),
    "four billion segments": (patched(BULK, 0, "<I", 2**32 - 1), "segment table has 4,294,967,296 segments"),
    "a thousand segments": (patched(BULK, 0, "<I", 999), "segment table has 1,000 segments"),
    "a longer segment": (patched(BULK, 4, "<I", 2**32 - 1), "segment table adds up to 34,359,738,368 bytes"),
    "a shorter segment": (patched(BULK, 4, "<I", 3), "segment table adds up to 32 bytes"),
    "no root": (patched(BULK, ROOT, "<q", 0), "root is a null pointer"),
    "a list as root": (patched(BULK, ROOT, "<I", 1), "a pointer is of kind 1; allowed: 0, a struct"),
    "root before the file": (patched(BULK, ROOT, "<i", -400), "is pointed to as the start of"),
    "root past the end": (patched(BULK, ROOT, "<i", 2**31 - 4), "is pointed to as the start of"),
    "a root of 1 MiB": (patched(BULK, ROOT + 4, "<I", 2**32 - 1), "is pointed to as the start of 131,070 words"),
    "far into no segment": (patched(BULK, ROOT, "<II", 2, 7), "segment 7, word 0"),
    "far past the end": (patched(BULK, ROOT, "<II", 2 | 1 << 20, 0), "segment 0, word 131,072"),
    "far to itself": (patched(BULK, ROOT, "<II", 2, 0), "is not a landing pad"),
    "double far to itself": (patched(BULK, ROOT, "<II", 6, 0), "is not a landing pad"),
    "a capability": (patched(BULK, ROOT, "<II", 3, 0), "a pointer is of kind 3"),
    "text that does not end": (BULK.replace(b"FloatValue\0", b"FloatValues"), "text without its end"),
    "text of no UTF-8": (patched(BULK, first(BULK, 0), "<B", 255), "pointer 0 is not UTF-8"),
    "children of 2 GiB": (patched(REPORT, pointer(1) + 4, "<I", 2**32 - 4), "start of 268,435,456 words"),
    "children of another size": (patched(REPORT, pointer(1) + 4, "<I", 136 << 3 | 5), "allowed: a list of <i4"),
    "children of structs": (patched(REPORT, pointer(1) + 4, "<I", 136 << 3 | 7), "element size 7; allowed: a list"),
    "seven children": (patched(REPORT, pointer(1) + 4, "<I", 7 << 3 | 4), "node_children has 7 numbers"),
    "a child out of range": (patched(REPORT, first(REPORT, 1), "<i", 99), "points to node 99"),
    "no data": (patched(REPORT, pointer(2), "<q", 0), "level_sizes adds up to 17 nodes; allowed: 1 to 0"),
    "data of one node less": (patched(REPORT, pointer(2) + 4, "<I", 208 << 3 | 4), "node_data has 208 values"),
    "a blob that is a list": (patched(BULK, pointer(9), "<I", 1), "a pointer is of kind 1"),
    "no width": (patched(BULK, ROOT + 8, "<i", 0), "size is 0x4x4"),
    "data_dim lies": (patched(BULK, ROOT + 20, "<i", 12), "data_dim is 12; allowed: 13"),
    "level sizes of another tree": (patched(BULK, first(BULK, 4), "<iii", 1, 7, 9), "level_sizes are"),
    "a shape of terabytes": (BULK.replace(SHAPE, struct.pack("<2Q", 2**63, 2**63)), "declares shape"),
    "another dtype": (BULK.replace(b"<f4", b"<f8"), "node_data has dtype '<f8'"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_lies_are_refused(lie: str) -> None:
    data, expected = LIES[lie]
    with pytest.raises((InvalidFile, InvalidScene), match=expected):
        read("svo.capnp", data).require_sound()


@pytest.mark.parametrize("index", [0, 3, 4, 5, 6, 8, 9])
def test_a_pointer_to_the_root_does_not_go_round(index: int) -> None:
    at = pointer(index)
    with pytest.raises((InvalidFile, InvalidScene)):
        read("svo.capnp", patched(BULK, at, "<iI", (8 - at) // 8 * 4 - 4, 2 | 10 << 16)).require_sound()
