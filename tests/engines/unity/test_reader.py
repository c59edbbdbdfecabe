"""The C# reader of engines/unity under Mono: the frozen files, points by the hundred thousand, and hostile files."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import build_octree, load, save
from nerfbake.scene.octree import SparseVoxelOctree
from tests.conformance.case import HOME, require_like
from tests.support.csharp import Reader, csharp_reader
from tests.support.octrees import points_around
from tests.support.scenes import n3tree

pytestmark = pytest.mark.tools
FILES = [
    (document, name)
    for document in sorted(HOME.glob("octree/*.expected.json"))
    for name in json.loads(document.read_text())["files"]
    if name.endswith(".svo.pb")
]
POINTS = 60_000  # of each kind of octree, and three quarters of that on faces and beside them


@pytest.fixture(scope="module")
def reader(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Reader]:
    with csharp_reader(tmp_path_factory.mktemp("csharp")) as found:
        yield found


# -- the frozen files ------------------------------------------------------------------------------------------
@pytest.mark.parametrize(("document", "name"), FILES, ids=[name for _, name in FILES])
def test_a_frozen_file_is_what_its_json_says(reader: Reader, document: Path, name: str) -> None:
    expected = json.loads(document.read_text())
    words, children, values = reader.facts(HOME / name)
    data_format, dtype, *numbers = words
    assert (data_format, dtype) == (expected["data_format"], expected["dtype"])
    assert list(map(int, numbers[:5])) == [*expected["size"], len(expected["node_data"]), expected["data_dim"]]
    assert list(map(int, numbers[5].split())) == expected["level_sizes"]
    assert list(map(float, numbers[6:])) == [*expected["origin"], *expected["voxel_size"]]
    assert children.tolist() == expected["node_children"]
    assert values.tolist() == expected["node_data"]
    tolerance = {"stored": 1e-5, "computed": 1e-5}
    require_like(looked_up(reader, HOME / name, expected), expected["lookups"], tolerance)


def looked_up(reader: Reader, path: Path, expected: dict[str, Any]) -> list[dict[str, Any]]:
    lookups = expected["lookups"]
    world = np.array([each["point"] for each in lookups])
    points = ((world - expected["origin"]) / expected["voxel_size"]).astype(np.float32)
    found = reader.asked("look up", path, points).reshape(2, len(points), -1).tolist()
    answers = [
        {"point": told["point"], "nearest": nearest, "trilinear": trilinear}
        for told, nearest, trilinear in zip(lookups, *found, strict=True)
    ]
    if "direction" in lookups[0]:
        directions = np.array([each["direction"] for each in lookups])
        asked = np.concatenate([points, directions], axis=1).astype(np.float32)
        colours = reader.asked("colours", path, asked).reshape(-1, 3).tolist()
        for answer, told, colour in zip(answers, lookups, colours, strict=True):
            answer |= {"direction": told["direction"], "colour": colour if any(answer["nearest"]) else None}
    return answers


# -- many points -----------------------------------------------------------------------------------------------
@pytest.fixture(scope="module")
def kinds() -> dict[str, SparseVoxelOctree]:
    """A box of voxels of three sizes, one compact octree of halves, and one of a single voxel."""
    random = np.random.default_rng(1)
    tree = n3tree(splits=[(0, (1, 0, 1)), (1, (0, 1, 0)), (2, (1, 1, 1))], data_format="SH4")
    box = build_octree(tree, resolution=(13, 16, 9), sigma_min=0.2)
    box = replace(box, origin=np.zeros(3), voxel_size=np.ones(3))
    box = replace(box, node_data=random.normal(size=box.node_data.shape).astype(np.float32))
    halves = replace(box.with_layout("compact"), node_data=box.node_data.astype(np.float16))
    one = SparseVoxelOctree((1, 1, 1), np.zeros((1, 8), np.int32), np.ones((1, 4), np.float32), "RGBA")
    return {"box": box, "halves": halves, "one": one}


@pytest.mark.parametrize("kind", ["box", "halves", "one"])
def test_a_hundred_thousand_points_give_the_same_voxels(
    reader: Reader, kinds: dict[str, SparseVoxelOctree], kind: str, tmp_path: Path
) -> None:
    octree = kinds[kind]
    save(tmp_path / "a.svo.pb", octree, no_child=-1 if kind == "box" else 0)
    points = points_around(octree, POINTS)
    assert len(points) > 100_000
    found = reader.asked("look up", tmp_path / "a.svo.pb", points).reshape(2, len(points), octree.data_dim)
    nearest = octree.sample(points.astype(np.float64))
    assert (found[0].view(np.int32) != nearest.view(np.int32)).sum() == 0
    assert 0.1 < (nearest != 0).any(axis=1).mean() < 0.9 or kind == "one"
    numbers = np.isfinite(points).all(axis=1)
    trilinear = octree.sample(points[numbers].astype(np.float64), lookup="trilinear")
    np.testing.assert_allclose(found[1][numbers], trilinear, rtol=1e-5, atol=1e-5)
    assert not found[1][~numbers].any()


# -- structs ---------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("data_format", ["RGBA", "SH1", "SH4", "SH9", "SH16", "SH25"])
@pytest.mark.parametrize("dtype", [np.float32, np.float16])
def test_structs_have_the_names_of_the_schema(reader: Reader, data_format: str, dtype: Any, tmp_path: Path) -> None:
    octree = build_octree(n3tree(data_format=data_format))
    octree = replace(octree, node_data=(octree.node_data + np.arange(octree.data_dim)).astype(dtype))
    for voxel_type in ("number", "struct"):
        save(tmp_path / f"{voxel_type}.svo.pb", octree, voxel_type=voxel_type)
        answer, steps, *named = reader.ask("names", tmp_path / f"{voxel_type}.svo.pb")
        assert (answer, steps) == ("ok", str(np.prod(octree.size)))
        values = dict(each.split("=") for each in named)
        last = octree.voxels[-1]
        expected: dict[str, Any] = {}
        for colour in ("red", "green", "blue"):
            names = last[colour].dtype.names
            own = {f"{colour}.{name}": last[colour][name] for name in names} if names else {colour: last[colour]}
            expected |= own
        expected["sigma"] = last["sigma"]
        assert [name.lower() for name in values] == list(expected)
        assert [np.float32(value) for value in values.values()] == [np.float32(value) for value in expected.values()]


def test_another_struct_than_the_files_is_refused(reader: Reader) -> None:
    answer, said = reader.ask("as SH9Voxel", HOME / "octree/sh4_float32_bulk.svo.pb")
    assert (answer, said) == ("refused", "node_data has 13 values a node, SH4; allowed: 28 in a SH9Voxel")


# -- hostile files ---------------------------------------------------------------------------------------------
def field(number: int, wire: int, payload: bytes) -> bytes:
    return bytes([number << 3 | wire]) + payload


SIZE = b"\x10\x02\x18\x02\x20\x02"  # 2 x 2 x 2
ONE = field(9, 2, b"\x01\x01") + field(6, 2, b"\x04abcd")


def nodes(*children: int, n: int = 2) -> bytes:
    table = np.zeros(8 * n, np.int32)
    table[: len(children)] = children
    return SIZE + field(13, 2, bytes([32 * n])) + table.tobytes() + field(6, 2, bytes([4 * n])) + bytes(4 * n)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "level_sizes adds up to 0 nodes; allowed: 1 to 0 for 0 bytes of node_data"),
        (field(1, 2, b"\x7f"), "byte 0 starts a field of 127 bytes; allowed: fields that end by 2"),
        (field(6, 2, b"\xff" * 9 + b"\x01"), "byte 0 starts a field of 18446744073709551615 bytes"),
        (field(1, 3, b""), "byte 0 has wire type 3; allowed: 0, 1, 2 or 5"),
        (field(0, 0, b"\x01"), "byte 0 starts field 0; allowed: fields from 1"),
        (b"\xff" * 11, "byte 0 starts a varint that does not end"),
        (field(2, 0, b"\x01") * 10_001, "message has more than 10000 fields"),
        (field(5, 0, b"\x01"), "field 5 has wire type 0; allowed: 2, as svo.proto declares it"),
        (field(5, 2, b"\x01\xff"), "starts a varint that does not end"),
        (field(5, 2, b"\x03\x01\x02\x03"), "node_children has 3 numbers; allowed: a multiple of 8"),
        (field(1, 2, b"\x01x"), "type_url is none that is known"),
        (field(1, 2, b"\x01\xff"), "field 1 is no UTF-8"),
        (ONE, "size is 0x0x0; allowed: 1 to 4096 voxels an axis"),
        (SIZE + field(4, 0, b"\x81\x20") + ONE, "size is 2x2x4097"),
        (SIZE + ONE + field(9, 2, b"\x01\x02"), "level_sizes adds up to 3 nodes"),
        (SIZE + field(9, 2, b"\x0a" + b"\xff" * 9 + b"\x01") + field(6, 2, b"\x04abcd"), "has a level of -1 nodes"),
        (SIZE + field(9, 2, b"\x06\x01" + b"\xff\xff\xff\xff\x07") + field(6, 2, b"\x04abcd"), "2147483648 nodes"),
        (SIZE + field(9, 2, b"\x01\x01") + field(6, 2, b"\x03abc"), "node_data has 3 bytes for 1 nodes"),
        (SIZE + ONE + field(8, 0, b"\x05"), "data_dim is 5; allowed: 1"),
        (SIZE + ONE + field(7, 2, b"\x03SH9"), "node_data has 1 values a node"),
        (SIZE + ONE + field(7, 2, b"\x03SH8"), "data_format is none that svox knows"),
        (SIZE + ONE + field(10, 2, b"\x01x"), "origin has 1 bytes; allowed: a multiple of 8"),
        (SIZE + ONE + field(11, 2, b"\x18" + bytes(24)), "voxel_size has an edge of 0"),
        (SIZE + ONE + field(10, 2, b"\x18" + np.full(3, np.nan).tobytes()), "origin has a number NaN"),
        (field(5, 2, b"\x01\x00") + field(13, 2, b"\x01\x00"), "message has fields 5 and 13"),
        (nodes(0, 2), "node_children[0] points to node 2; allowed: 0 to 1, or -1"),
        (nodes(0, -2), "node_children[0] points to node -2"),
        (nodes(1, 1), "node_children[0] points to node 1, which has a parent already"),
        (nodes(*[0] * 9, 1), "node_children leads to 1 of 2 nodes"),
        (nodes(1, *[0] * 8, 1), "node_children[1] points to node 1, which has a parent already"),
        (nodes(1, *[0] * 7, 2, n=3), "has more than 1 levels below the root"),
    ],
)
def test_lies_are_refused_in_one_line(reader: Reader, data: bytes, said: str, tmp_path: Path) -> None:
    (tmp_path / "a.svo.pb").write_bytes(data)
    answer, *words = reader.ask("read", tmp_path / "a.svo.pb", tmp_path / "out")
    assert answer == "refused", words
    assert said in words[0]


def test_broken_files_are_read_or_refused(reader: Reader, tmp_path: Path) -> None:
    """Cut anywhere, bytes changed anywhere: never another exception, never a reader that does not come back. What is
    read has the values that ours finds, and ours reads it, too."""
    random, answers = np.random.default_rng(2), []
    for path in sorted(HOME.glob("octree/*_report.svo.pb"))[:3]:
        whole = np.frombuffer(path.read_bytes(), np.uint8)
        for i in range(150):
            broken = whole[: random.integers(0, len(whole))] if i % 5 == 0 else whole.copy()
            if i % 5:
                places = random.integers(0, len(broken), 1 + i % 3)
                broken[places] = random.integers(0, 256, len(places))
            (tmp_path / "a.svo.pb").write_bytes(broken.tobytes())
            answer, *words = reader.ask("read", tmp_path / "a.svo.pb", tmp_path / "out")
            answers.append(answer)
            assert answer in ("ok", "refused"), (path.name, i, words)
            if answer == "ok":
                octree = load(tmp_path / "a.svo.pb", SparseVoxelOctree)
                assert list(map(int, words[2:6])) == [*octree.size, octree.n]
                assert octree.structure_problems() == []
    assert {"ok", "refused"} <= set(answers)
