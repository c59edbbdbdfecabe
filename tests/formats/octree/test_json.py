from __future__ import annotations

import base64
import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings

from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.formats.octree import json as octree_json
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.octrees import read, small_octree, written
from tests.support.scenes import assert_same_octree, octrees


@settings(max_examples=20)
@given(octrees())
def test_pythons_own_json_reads_the_report_profile(octree: SparseVoxelOctree) -> None:
    document = json.loads(written("svo.json", "report", octree))
    assert [document[key] for key in ("width", "height", "depth")] == list(octree.size)
    assert document["type_url"].endswith(
        {"float32": ".FloatValue", "float16": ".Float16Value"}[octree.node_data.dtype.name]
    )
    assert document["node_children"] == octree.node_children.ravel().tolist()
    assert np.array(document["node_data"]).astype(octree.node_data.dtype).tobytes() == octree.node_data.tobytes()
    assert document["level_sizes"] == octree.level_sizes
    assert document["data_dim"] == octree.data_dim
    assert document["data_format"] == octree.data_format
    assert document["origin"] == octree.origin.tolist()
    assert document["voxel_size"] == octree.voxel_size.tolist()


@settings(max_examples=20)
@given(octrees())
def test_pythons_own_json_reads_the_bulk_profile(octree: SparseVoxelOctree) -> None:
    document = json.loads(written("svo.json", "bulk", octree))
    for name in ("node_children", "node_data"):
        blob, values = document[name], getattr(octree, name)
        assert (blob["dtype"], blob["shape"]) == (values.dtype.str, list(values.shape))
        assert base64.b64decode(blob["data"], validate=True) == values.tobytes()


def test_what_pythons_own_json_writes_is_read() -> None:
    octree = small_octree()
    fields = {
        "width": 4,
        "height": 4,
        "depth": 4,
        "node_children": np.where(octree.node_children == 0, -1, octree.node_children).ravel().tolist(),
        "node_data": octree.node_data.ravel().tolist(),
    }
    back = read("svo.json", json.dumps(fields, indent=1).encode())
    assert_same_octree(back, replace(octree, origin=np.zeros(3), voxel_size=np.ones(3)))


def test_a_byte_order_mark_is_no_part_of_the_octree() -> None:
    octree = small_octree()
    data = b"\xef\xbb\xbf" + written("svo.json", "report", octree)
    assert octree_json.recognise(memoryview(data))
    assert_same_octree(read("svo.json", data), octree)


def test_long_arrays_are_written_in_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    octree = small_octree()
    whole = [written("svo.json", profile, octree) for profile in ("report", "bulk")]
    monkeypatch.setattr(octree_json, "_CHUNK", 12)
    assert [written("svo.json", profile, octree) for profile in ("report", "bulk")] == whole


@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize("name", ["node_data", "origin", "voxel_size"])
def test_what_json_cannot_say_is_refused_before_anything_is_written(name: str, value: float) -> None:
    octree = small_octree()
    values = np.array(getattr(octree, name))
    values.ravel()[2] = value
    changes: dict[str, Any] = {name: values}
    octree = replace(octree, **changes)
    with pytest.raises(InvalidScene, match=f"{name} holds NaN or infinity; allowed: finite numbers in svo.json"):
        next(octree_json.encode(octree, profile="report"))
    if name == "node_data":
        assert_same_octree(read("svo.json", written("svo.json", "bulk", octree)), octree)


def document(**changes: Any) -> bytes:
    fields = json.loads(written("svo.json", "report", small_octree()))
    return json.dumps({key: value for key, value in (fields | changes).items() if value is not ...}).encode()


def blob(**changes: Any) -> dict[str, Any]:
    return {"dtype": "<f4", "shape": [17, 13], "data": base64.b64encode(bytes(17 * 13 * 4)).decode()} | changes


LIES: dict[str, tuple[bytes, str]] = {
    "an empty list": (b"[]", "JSON holds a list"),
    "no fields": (b"{}", "level_sizes adds up to 0 nodes"),
    "half an object": (b'{"width": 1', "JSON cannot be parsed"),
    "no UTF-8": (b'{"\xff": 1}', "JSON cannot be parsed"),
    "deep brackets": (b"{" + b'"a":[' * 3000, "JSON cannot be parsed"),
    "width is text": (document(width="4"), "width is 4; allowed: a whole number"),
    "width is true": (document(width=True), "width is True; allowed: a whole number"),
    "width is huge": (document(width=2**80), "JSON cannot be parsed|width is"),
    "type_url is a number": (document(type_url=1), "type_url is int; allowed: text"),
    "unknown type_url": (document(type_url="double"), "type_url is 'double'"),
    "children are text": (document(node_children="12345678"), "node_children is str; allowed: a flat list"),
    "children are fractions": (document(node_children=[0.5] * 8), "node_children holds a value that is not a number"),
    "children are lists": (document(node_children=[[0] * 8]), "node_children holds a value that is not a number"),
    "children beyond 32 bits": (document(node_children=[2**40] + [0] * 135), "node_children holds 1099511627776"),
    "children beyond 64 bits": (document(node_children=[2**70] + [0] * 135), "node_children holds"),
    "a child out of range": (document(node_children=[99] + [0] * 135), "points to node 99"),
    "too few children": (document(node_children=[0] * 7), "node_children has 7 numbers; allowed: a multiple of 8"),
    "data hold null": (document(node_data=[None] * 221), "node_data holds a value that is not a number"),
    "data hold text": (document(node_data=["1"] * 221), "node_data holds a value that is not a number"),
    "data beyond float32": (document(node_data=[1e300] * 221), r"node_data holds 1e\+300"),
    "data too short": (document(node_data=[1] * 220), "node_data has 220 values"),
    "no data": (document(node_data=...), "level_sizes adds up to 17 nodes"),
    "data_dim lies": (document(data_dim=12), "data_dim is 12; allowed: 13"),
    "level sizes of another tree": (document(level_sizes=[1, 7, 9]), "level_sizes are"),
    "negative level sizes": (document(level_sizes=[18, -1]), "level_sizes adds up to 17 nodes"),
    "origin of true and false": (document(origin=[0, True, False]), "origin holds a value that is not a number"),
    "level sizes that are true": (document(level_sizes=[True, 8, 8]), "level_sizes holds a value that is not a number"),
    "lobes that are true": (document(extra_data=[True] * 16), "extra_data holds a value that is not a number"),
    "origin of two": (document(origin=[0, 0]), "origin has 2 numbers; allowed: 3"),
    "unknown data_format": (document(data_format="SH99"), "data_format is 'SH99'"),
    "lobes of nothing": (document(data_format="", extra_data=[1.0]), "data_format is ''"),
    "blob without data": (document(node_data={"dtype": "<f4"}), "node_data is not a blob"),
    "blob of another dtype": (document(node_data=blob(dtype="<f8")), "node_data has dtype '<f8'; allowed: '<f4'"),
    "blob of another shape": (document(node_data=blob(shape=[17, 14])), r"declares shape \(17, 14\)"),
    "blob of terabytes": (document(node_data=blob(shape=[2**40, 2**40])), "node_data declares shape"),
    "blob of negative shape": (document(node_data=blob(shape=[-17, -13])), "node_data declares shape"),
    "blob of fractions": (document(node_data=blob(shape=[17.0, 13])), "node_data is not a blob"),
    "flat blob": (document(node_data=blob(shape=[221])), "node_data declares shape"),
    "blob of other rows": (document(node_data=blob(shape=[13, 17])), "node_data has 221 values"),
    "no base64": (document(node_data=blob(data="!!!!")), "data that is not base64"),
    "not ASCII": (document(node_data=blob(data="é")), "data that is not base64"),
}  # fmt: skip


@pytest.mark.parametrize("lie", LIES)
def test_lies_are_refused(lie: str) -> None:
    data, expected = LIES[lie]
    with pytest.raises((InvalidFile, InvalidScene), match=expected):
        read("svo.json", data).require_sound()


@pytest.mark.parametrize("filling", [b"[],", b"{},", b'"",', b"0.5,"])
def test_text_that_grows_when_parsed_is_refused_first(filling: bytes) -> None:
    with pytest.raises(MemoryLimit, match="the JSON, parsed, needs"):
        read("svo.json", b'{"node_data":[' + filling * 100_000 + b"0]}", limit=1 << 21)
