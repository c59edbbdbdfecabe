from __future__ import annotations

import importlib
import json
import mmap
import struct
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import flatbuffers
import numpy as np
import pytest
from hypothesis import given, settings
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats.octree import flatbuffers as octree_flatbuffers
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.octrees import read, small_octree, written
from tests.support.scenes import assert_same_octree, octrees
from tests.support.tools import SCHEMAS, tool


def as_json(data: bytes, folder: Path) -> dict[str, Any]:
    """The file as flatc prints it."""
    (folder / "a.fb").write_bytes(data)
    tool("flatc", "--json", "--strict-json", "-o", folder, SCHEMAS / "svo.fbs", "--", folder / "a.fb")
    document: dict[str, Any] = json.loads((folder / "a.json").read_text())
    return document


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_flatc_reads_the_report_profile(dtype: type, tmp_path: Path) -> None:
    octree = small_octree(dtype)
    document = as_json(written("svo.fb", "report", octree), tmp_path)
    assert document["node_children"] == octree.node_children.ravel().tolist()
    # flatc prints six digits; these values have no more.
    assert document["node_data"] == octree.node_data.ravel().tolist()
    assert [document[key] for key in ("width", "height", "depth", "data_dim")] == [4, 4, 4, 13]
    assert document["level_sizes"] == octree.level_sizes
    assert document["data_format"] == "SH4"
    assert document["origin"] == octree.origin.tolist()
    assert document["voxel_size"] == octree.voxel_size.tolist()
    assert document["type_url"].endswith("FloatValue" if dtype is np.float32 else "Float16Value")


@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_flatc_reads_the_bulk_profile(dtype: type, tmp_path: Path) -> None:
    octree = small_octree(dtype)
    document = as_json(written("svo.fb", "bulk", octree), tmp_path)
    for name, values in (("children_blob", octree.node_children), ("data_blob", octree.node_data)):
        assert document[name]["dtype"] == values.dtype.str
        assert document[name]["shape"] == list(values.shape)
        assert bytes(document[name]["data"]) == values.tobytes()


def test_what_flatc_writes_is_read(tmp_path: Path) -> None:
    octree = small_octree()
    fields = {"width": 4, "height": 4, "depth": 4, "data_dim": 13, "voxel_size": [0.5, 1, 2]}
    fields |= {"node_children": octree.node_children.ravel().tolist(), "node_data": octree.node_data.ravel().tolist()}
    (tmp_path / "a.json").write_text(json.dumps(fields))
    tool("flatc", "--binary", "-o", tmp_path, SCHEMAS / "svo.fbs", tmp_path / "a.json")
    (binary,) = tmp_path.glob("*.fb")
    assert octree_flatbuffers.recognise(memoryview(binary.read_bytes()))
    back = read("svo.fb", binary.read_bytes())
    assert_same_octree(back, replace(octree, origin=np.zeros(3), data_format="SH4" if back.data_format else ""))


@pytest.fixture(scope="module")
def generated(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The class that flatc makes of the schema."""
    folder = tmp_path_factory.mktemp("generated")
    tool("flatc", "--python", "-o", folder, SCHEMAS / "svo.fbs")
    sys.path.insert(0, str(folder))
    try:
        return importlib.import_module("SVO.FlatBuffers.SparseVoxelOctree").SparseVoxelOctree
    finally:
        sys.path.remove(str(folder))


@settings(max_examples=20)
@given(octree=octrees())
def test_generated_code_reads_both_profiles(generated: Any, octree: SparseVoxelOctree) -> None:
    report = generated.GetRootAs(written("svo.fb", "report", octree), 0)
    assert generated.SparseVoxelOctreeBufferHasIdentifier(written("svo.fb", "report", octree), 0)
    assert_array_equal(report.NodeChildrenAsNumpy(), octree.node_children.ravel())
    assert_array_equal(report.NodeDataAsNumpy(), octree.node_data.ravel().astype(np.float32))
    assert (report.Width(), report.Height(), report.Depth()) == octree.size
    assert report.LevelSizesAsNumpy().tolist() == octree.level_sizes
    assert report.OriginAsNumpy().tolist() == octree.origin.tolist()
    bulk = generated.GetRootAs(written("svo.fb", "bulk", octree), 0)
    assert bulk.NodeDataIsNone()
    assert bulk.DataBlob().DataAsNumpy().tobytes() == octree.node_data.tobytes()
    assert bulk.DataBlob().ShapeAsNumpy().tolist() == list(octree.node_data.shape)
    assert bulk.ChildrenBlob().Dtype() == b"<i4"


@pytest.mark.parametrize("profile", ["report", "bulk"])
@given(octree=octrees())
@settings(max_examples=20)
def test_vectors_are_aligned_as_other_readers_require(profile: str, octree: SparseVoxelOctree) -> None:
    data = written("svo.fb", profile, octree)
    for values in (octree.origin, octree.voxel_size):
        assert data.index(struct.pack("<I", 3) + values.tobytes()) % 8 == 4


def test_what_the_library_writes_is_read() -> None:
    octree = small_octree(np.float16)
    builder = flatbuffers.Builder()
    vectors = {
        0: builder.CreateString("type.googleapis.com/svo.protobuf.Float16Value"),
        4: builder.CreateNumpyVector(octree.node_children.ravel()),
        5: builder.CreateNumpyVector(octree.node_data.astype(np.float32).ravel()),
        10: builder.CreateNumpyVector(octree.voxel_size),
    }
    builder.StartObject(14)
    for slot, offset in vectors.items():
        builder.PrependUOffsetTRelativeSlot(slot, offset, 0)
    for slot, edge in enumerate(octree.size, start=1):
        builder.PrependInt32Slot(slot, edge, 0)
    builder.Finish(builder.EndObject())
    back = read("svo.fb", bytes(builder.Output()))
    assert_same_octree(back, replace(octree, origin=np.zeros(3), data_format=back.data_format))


def test_more_than_two_gibibytes_are_refused_before_anything_is_written() -> None:
    octree = small_octree()
    huge = replace(octree, node_data=np.broadcast_to(octree.node_data[:1], (2**31 // 52, 13)))
    with pytest.raises(InvalidScene, match=r"svo\.fb would take 2,148,\d+,\d+ bytes; allowed: 2,147,483,647"):
        next(octree_flatbuffers.encode(huge))


def test_a_longer_file_than_flatbuffers_can_have_is_refused() -> None:
    with mmap.mmap(-1, 2**31) as pages, memoryview(pages) as view:  # of which only the first is ever touched
        pages[:8] = struct.pack("<I4s", 2**31 - 4, b"SVO1")
        with pytest.raises(InvalidFile, match=r"the file has 2,147,483,648 bytes; allowed: 2,147,483,647, Flat"):
            octree_flatbuffers.decode(view)


BULK, REPORT = (written("svo.fb", profile, small_octree()) for profile in ("bulk", "report"))
ROOT = struct.unpack_from("<I", BULK)[0]
VTABLE = ROOT - struct.unpack_from("<i", BULK, ROOT)[0]


SHAPE = struct.pack("<2Q", 17, 13)


def patched(data: bytes, at: int, kind: str, value: int) -> bytes:
    broken = bytearray(data)
    struct.pack_into(kind, broken, at, value)
    return bytes(broken)


def field(slot: int, data: bytes = BULK) -> int:
    """Where a field of the root table stands."""
    root = struct.unpack_from("<I", data)[0]
    vtable = root - struct.unpack_from("<i", data, root)[0]
    return int(root + struct.unpack_from("<H", data, vtable + 4 + 2 * slot)[0])


def vector(data: bytes, at: int) -> int:
    return int(at + struct.unpack_from("<I", data, at)[0])


LIES: dict[str, tuple[bytes, str]] = {
    "seven bytes": (BULK[:7], "an offset points to byte"),
    "root past the end": (patched(BULK, 0, "<I", 2**32 - 1), "an offset points to byte 4,294,967,295"),
    "root at the end": (patched(BULK, 0, "<I", len(BULK) - 3), "an offset points to byte"),
    "vtable before the file": (patched(BULK, ROOT, "<i", 2**31 - 1), "an offset points to byte -2,147"),
    "vtable past the end": (patched(BULK, ROOT, "<i", -(2**31)), "an offset points to byte 2,147"),
    "vtable of two bytes": (patched(BULK, VTABLE, "<H", 2), "has a vtable of 2 bytes"),
    "vtable of 64 KiB": (patched(BULK, VTABLE, "<H", 65535), "has a vtable of 65535 bytes"),
    "table of 64 KiB": (patched(BULK, VTABLE + 2, "<H", 65535), "allowed: a table inside the file"),
    "field outside the table": (patched(BULK, VTABLE + 6, "<H", 60000), "puts field 1 at 60000 of"),
    "field over the vtable's offset": (patched(BULK, VTABLE + 6, "<H", 1), "puts field 1 at 1 of"),
    "text past the end": (patched(BULK, field(0), "<I", 2**32 - 1), "an offset points to byte"),
    "text that goes on": (patched(BULK, vector(BULK, field(0)), "<I", 2**32 - 1), "field 0 has 4,294,967,295 bytes"),
    "a table past what the runtime counts": (patched(BULK, field(12), "<I", 2**32 - 1), "an offset points to byte 4,2"),
    "text of no UTF-8": (patched(BULK, vector(BULK, field(0)) + 4, "<B", 255), "field 0 is not UTF-8"),
    "16 GiB of children": (patched(REPORT, vector(REPORT, field(4, REPORT)), "<I", 2**32 - 1), "field 4 has 17,179,"),
    "seven children": (patched(REPORT, vector(REPORT, field(4, REPORT)), "<I", 7), "node_children has 7 numbers"),
    "a child out of range": (patched(REPORT, vector(REPORT, field(4, REPORT)) + 4, "<i", 99), "points to node 99"),
    "a negative child": (patched(REPORT, vector(REPORT, field(4, REPORT)) + 4, "<i", -5), "points to node -5"),
    "data of one node less": (patched(REPORT, vector(REPORT, field(5, REPORT)), "<I", 208), "node_data has 208 values"),
    "no width": (patched(BULK, field(1), "<i", 0), "size is 0x4x4"),
    "negative depth": (patched(BULK, field(3), "<i", -4), "size is 4x4x-4"),
    "data_dim lies": (patched(BULK, field(7), "<i", 12), "data_dim is 12; allowed: 13"),
    "level sizes of another tree": (patched(BULK, vector(BULK, field(8)) + 8, "<i", 9), "for 18 nodes"),
    "level sizes overflow": (patched(BULK, vector(BULK, field(8)) + 8, "<i", 2**31 - 1), "level_sizes adds up to"),
    "a shape of terabytes": (BULK.replace(SHAPE, struct.pack("<2Q", 2**63, 2**63)), "declares shape"),
    "another shape": (BULK.replace(SHAPE, struct.pack("<2Q", 17, 12)), "node_data declares shape"),
    "another dtype": (BULK.replace(b"<f4", b"<f8"), "node_data has dtype '<f8'"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_lies_are_refused(lie: str) -> None:
    data, expected = LIES[lie]
    with pytest.raises((InvalidFile, InvalidScene), match=expected):
        read("svo.fb", data).require_sound()
