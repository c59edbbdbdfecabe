from __future__ import annotations

import struct
from dataclasses import replace
from typing import Any

import bson
import numpy as np
import pytest
from bson.binary import Binary
from hypothesis import given, settings

from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.octree import bson as octree_bson
from nerfbake.formats.octree import bson as wire_bson
from nerfbake.formats.octree.fields import small_fields
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.octrees import read, small_octree, written
from tests.support.scenes import assert_same_octree, octrees


def report_fields(octree: SparseVoxelOctree) -> dict[str, Any]:
    children, data = octree.node_children.ravel().tolist(), octree.node_data.ravel().tolist()
    return small_fields(octree) | {"node_children": children, "node_data": data}


@settings(max_examples=20)
@given(octrees())
def test_the_report_profile_is_what_pymongo_writes(octree: SparseVoxelOctree) -> None:
    assert written("svo.bson", "report", octree) == bson.encode(report_fields(octree))


@settings(max_examples=20)
@given(octrees())
def test_the_bulk_profile_is_what_pymongo_writes(octree: SparseVoxelOctree) -> None:
    blobs = {
        name: {"dtype": values.dtype.str, "shape": list(values.shape), "data": Binary(values.tobytes())}
        for name, values in (("node_children", octree.node_children), ("node_data", octree.node_data))
    }
    assert written("svo.bson", "bulk", octree) == bson.encode(small_fields(octree) | blobs)


@settings(max_examples=20)
@given(octrees())
def test_pymongo_reads_the_values(octree: SparseVoxelOctree) -> None:
    report = bson.decode(written("svo.bson", "report", octree))
    assert report["node_children"] == octree.node_children.ravel().tolist()
    assert report["node_data"] == octree.node_data.ravel().tolist()
    bulk = bson.decode(written("svo.bson", "bulk", octree))
    assert bulk["node_data"]["data"] == octree.node_data.tobytes()
    assert [bulk[key] for key in ("width", "height", "depth")] == list(octree.size)


def test_indices_of_any_length_are_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    values = np.arange(1, 100_123, dtype=np.float32).reshape(1, -1)
    octree = SparseVoxelOctree((1, 1, 1), np.zeros((1, 8), np.int32), values)
    whole = written("svo.bson", "report", octree)
    assert whole == bson.encode(report_fields(octree))
    monkeypatch.setattr(wire_bson, "_CHUNK", 1000)
    assert written("svo.bson", "report", octree) == whole
    assert_same_octree(read("svo.bson", whole), octree)


def test_numbers_of_mixed_types_are_read() -> None:
    # As a program writes them that has one type of number, and stores whole ones as integers.
    octree = small_octree()
    fields = report_fields(octree)
    fields["node_data"] = [int(value) if value == int(value) else value for value in fields["node_data"]]
    assert {type(value) for value in fields["node_data"]} == {int, float}
    fields["node_children"] = [bson.Int64(child) for child in fields["node_children"]]
    assert_same_octree(read("svo.bson", bson.encode(fields)), octree)


def test_whole_numbers_of_any_size_are_exact() -> None:
    octree = small_octree()
    fields = report_fields(octree)
    fields["node_children"] = [bson.Int64(child) if i % 3 else child for i, child in enumerate(fields["node_children"])]
    fields["node_children"] = [-1 if child == 0 else child for child in fields["node_children"]]
    fields["level_sizes"] = [bson.Int64(fields["level_sizes"][0]), *fields["level_sizes"][1:]]
    fields["origin"], fields["voxel_size"] = [1, -2.5, bson.Int64(-(2**40))], [1, 1, 1]
    found = read("svo.bson", bson.encode(fields))
    assert found.origin.tolist() == [1, -2.5, -(2**40)]
    assert_same_octree(replace(found, origin=octree.origin, voxel_size=octree.voxel_size), octree)


def test_what_an_octree_does_not_have_is_skipped() -> None:
    more: dict[str, Any] = {
        "_id": bson.ObjectId(),
        "extra_data": None,
        "note": {"deep": [{"er": [None, True, {}]}]},
        "when": bson.DatetimeMS(0),
        "raw": b"123",
    }
    assert_same_octree(read("svo.bson", bson.encode({**more, **report_fields(small_octree())})), small_octree())


def test_mixed_numbers_count_against_max_memory() -> None:
    fields = report_fields(small_octree())
    fields["node_data"][-1] = 1
    with pytest.raises(MemoryLimit, match="node_data needs"):
        read("svo.bson", bson.encode(fields), limit=3_000)


@pytest.mark.parametrize(("profile", "rows"), [("report", 2**31 // (13 * 17)), ("bulk", 2**31 // (13 * 4) + 1)])
def test_more_than_two_gibibytes_are_refused_before_anything_is_written(
    profile: Any, rows: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(SparseVoxelOctree, "level_sizes", [1])  # of a tree that is not there
    octree = small_octree()
    huge = replace(octree, node_data=np.broadcast_to(octree.node_data[:1], (rows, octree.data_dim)))
    with pytest.raises(InvalidScene, match=r"svo\.bson would take 2,\d+,\d+,\d+ bytes"):
        next(octree_bson.encode(huge, profile=profile))


def changed(profile: str, **changes: Any) -> bytes:
    return bson.encode(bson.decode(written("svo.bson", profile, small_octree())) | changes)


def blob(**changes: Any) -> dict[str, Any]:
    return {"dtype": "<f4", "shape": [17, 13], "data": Binary(bytes(17 * 13 * 4))} | changes


def with_sizes(old: int, new: int) -> bytes:
    data = written("svo.bson", "bulk", small_octree())
    assert struct.pack("<i", old) in data
    return data.replace(struct.pack("<i", old), struct.pack("<i", new), 1)


def mixed(elements: bytes) -> bytes:
    """An octree whose node_data are these elements."""
    whole = changed("report", node_data=[])
    array = struct.pack("<i", len(elements) + 5) + elements + b"\0"
    document = whole[4:-1].replace(b"\4node_data\0" + bson.encode({}), b"\4node_data\0" + array)
    return struct.pack("<i", len(document) + 5) + document + b"\0"


BULK, REPORT = (written("svo.bson", profile, small_octree()) for profile in ("bulk", "report"))
WHOLE = len(BULK)
LIES: dict[str, tuple[bytes, str]] = {
    "four bytes": (b"\x04\0\0\0", "document declares"),
    "shorter than it says": (with_sizes(WHOLE, WHOLE + 1), "document declares"),
    "longer than it says": (with_sizes(WHOLE, WHOLE - 1), "document declares"),
    "a binary of 2 GiB": (with_sizes(884, 2**31 - 1), "starts 2,147,483,652 bytes"),
    "a negative binary": (with_sizes(884, -884), "starts BSON type 5 of -884 bytes"),
    "a shorter binary": (with_sizes(884, 880), "starts BSON type 0|declares|is no"),
    "an unknown type": (BULK.replace(b"\x10width", b"\x7fwidth"), "BSON type 127"),
    "children are text": (changed("report", node_children="x" * 8), "node_children has BSON type 2"),
    "children are fractions": (changed("report", node_children=[0.5] * 136), "node_children holds 0.5"),
    "children are documents": (changed("report", node_children=[{}] * 136), "node_children holds a value that is not"),
    "data hold null": (changed("report", node_data=[None] * 221), "node_data holds a value that is not"),
    "data beyond float32": (changed("report", node_data=[1e300] * 221), r"node_data holds 1e\+300"),
    "no data": (changed("report", node_data=[]), "level_sizes adds up to 17 nodes; allowed: 1 to 0"),
    "origin is a number": (changed("report", origin=1.5), "origin is float; allowed: a flat list"),
    "width is a float": (changed("report", width=4.0), "width is 4.0; allowed: a whole number"),
    "a date": (changed("report", width=bson.DatetimeMS(2**62)), "width has BSON type 9"),
    "level sizes are fractions": (changed("report", level_sizes=[1.0, 16]), "level_sizes holds a value that is not a"),
    "level sizes are true": (changed("report", level_sizes=[True, 16]), "level_sizes holds a value that is not a"),
    "level sizes are lists": (changed("report", level_sizes=[[1], 16]), "level_sizes holds a value that is not a"),
    "text is not UTF-8": (BULK.replace(b"type.goo", b"t\xffpe.goo"), "type_url is not text; allowed: UTF-8"),
    "an array without an end": (REPORT[:-2] + b"\1\0", "node_data declares"),
    "a number without an end": (mixed(b"\x120\0" + bytes(8) + b"\x101\0\0\0"), "node_data holds a value that is not"),
    "a name without an end": (mixed(b"\x120\0" + bytes(8) + b"\x10111111"), "node_data holds a value that is not"),
    "blob of another dtype": (changed("bulk", node_data=blob(dtype="<f8")), "node_data has dtype"),
    "blob of another shape": (changed("bulk", node_data=blob(shape=[17, 14])), "node_data declares shape"),
    "blob of negative shape": (changed("bulk", node_data=blob(shape=[-17, -13])), "node_data declares shape"),
    "blob without bytes": (changed("bulk", node_data={"dtype": "<f4", "shape": [17, 13]}), "node_data is not a blob"),
    "blob of text": (changed("bulk", node_data=blob(data="x" * 884)), "node_data is not a blob"),
    "blob of another subtype": (changed("bulk", node_data=blob(data=Binary(bytes(884), 2))), "node_data is not a blob"),
    "too many elements": (bson.encode({f"x{i}": 1 for i in range(1001)}), "more than 1,000 elements"),
    "large small fields": (changed("bulk", data_format="x" * (1 << 24)), "data_format has 16,777,221 bytes"),
    "level sizes of another tree": (changed("bulk", level_sizes=[1, 7, 9]), "level_sizes are"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_lies_are_refused(lie: str) -> None:
    data, expected = LIES[lie]
    with pytest.raises((InvalidFile, InvalidScene), match=expected):
        read("svo.bson", data)
