"""What was written once is read for ever, gives the values that stand beside it, and is written the same again."""

from __future__ import annotations

import io
import json
import math
import re
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
import zstandard

from nerfbake import catalog
from tests.conformance.case import HOME, Case, require_like, text_of
from tests.conformance.cases import CASES
from tests.conformance.gaussian_splatting.files import HOME as SET
from tests.conformance.octrees import path_of
from tests.conformance.packing import packed_by, unpacked
from tests.conformance.volumes import scenes as volume_scenes
from tests.conformance.voxels import harmonics
from tests.support.octrees import SPELLINGS

FILES = [(case, name) for case in CASES for name in case.files]
FOLDERS = [form.name for form in catalog.FOLDERS]
each_file = pytest.mark.parametrize(("case", "name"), FILES, ids=[name for _, name in FILES])


def document_of(case: Case) -> dict[str, Any]:
    document: dict[str, Any] = json.loads(case.path.read_text())
    return document


@each_file
def test_a_frozen_file_is_read_as_its_json_says(case: Case, name: str) -> None:
    document = document_of(case)
    expected = {key: value for key, value in document.items() if key not in ("about", "files", "tolerance")}
    require_like(case.answer(HOME / name, expected), expected, document["tolerance"])


@pytest.mark.parametrize("case", CASES, ids=[case.name for case in CASES])
def test_the_json_says_what_the_scene_is(case: Case) -> None:
    """Numbers that are computed may differ in their last bits from one C library or processor to the next.

    What networks answer is computed in float32.
    """
    ours, document = json.loads(text_of(case.document(lambda _: {}))), document_of(case)
    for told in document["files"].values():
        told["packed_by"] = {path: {} for path in told["packed_by"]} if told["format"] in FOLDERS else {}
    require_like(ours, document, {"stored": 0, "computed": 1e-6 if case.name.startswith("function/") else 1e-12})


@each_file
def test_a_frozen_file_is_written_again(case: Case, name: str) -> None:
    """Byte for byte, unless another version of a library packs it: then what unpacks is the same."""
    for path, data in case.files[name].written(name).items():
        frozen = (HOME / path).read_bytes()
        if case.recorded()[path] == packed_by(path):
            assert data == frozen, path
        assert unpacked(path, data) == unpacked(path, frozen), path


def frozen_files() -> list[Path]:
    """All but the set for KHR_gaussian_splatting, which has its own tests."""
    return [path for path in HOME.rglob("*") if path.is_file() and SET not in path.parents]


def test_nothing_else_lies_there() -> None:
    expected = {"README.md", ".gitattributes"} | {f"{case.name}.expected.json" for case in CASES}
    for case in CASES:
        expected |= set(case.recorded())
    assert {str(path.relative_to(HOME)) for path in frozen_files()} == expected


# A page to look around in holds its own program, which may be bettered; what it carries are the bytes of a .svoq.
FROZEN = [form for form in catalog.FORMATS if form.scene != "Page"]


@pytest.mark.parametrize("form", FROZEN, ids=lambda form: form.name)
def test_every_format_has_a_frozen_file_in_every_profile(form: catalog.Format) -> None:
    frozen = [each for case in CASES for each in case.files.values() if each.form == form]
    profiles = form.choices("profile") if form.writable else ()
    assert {each.options.get("profile") for each in frozen} >= set(profiles or (None,))


@pytest.mark.parametrize("scene", sorted({form.scene for form in catalog.FOLDERS}))
def test_every_folder_that_is_written_has_a_frozen_one(scene: str) -> None:
    assert catalog.folders_of(scene)[0] in [each.form for case in CASES for each in case.files.values()]


def test_the_frozen_files_are_small() -> None:
    sizes = [path.stat().st_size for path in frozen_files()]
    assert max(sizes) < 40_000
    assert sum(sizes) < 1_160_000


def test_every_spelling_of_every_octree_is_frozen() -> None:
    names = {name for _, name in FILES}
    for scene in ("full_float32", "compact_float16", "lobes_float32", "sh4_float32", "full_float32_minus1"):
        assert {path_of(*spelling, scene) for spelling in SPELLINGS} <= names


# -- figures that were worked out by hand, so that the arithmetic behind the JSON is held to something ----------
def facts_named(name: str) -> dict[str, Any]:
    return next(case.facts for case in CASES if case.name == name)


def test_lookups_of_the_octree_by_hand() -> None:
    lookups = {tuple(each["point"]): each for each in facts_named("octree/sh4_float32")["lookups"]}
    # Voxel (0, 0, 0) is in row 4, whose density is 1; voxel (3, 3, 1) is row 9, its own.
    first, ninth = lookups[-0.9375, 0.59375, 0.375], lookups[-0.1875, 0.953125, 1.0625]
    assert (first["nearest"][12], ninth["nearest"][12]) == (1, 0.125)
    # In voxels (3.25, 3.625, 1.625): a quarter of x = 2, an eighth of y = 4 (outside), an eighth of z = 2 (empty).
    # x = 2 is empty at y = 3, z = 1: row 5 has voxels (2, 2, 0) and (3, 3, 1) only.
    assert ninth["trilinear"][12] == 0.125 * 0.75 * 0.875 * 0.875


def test_lookups_of_tiles_by_hand() -> None:
    (grid,) = facts_named("volume/tiles")["grids"]
    assert [each["nearest"][0] for each in grid["lookups"] if each["where"] == "tile"] == [0.5, 2.5, 1.25, 7.0]
    # Three quarters of the way from the background (0.25) at x = 7 into the tile (0.5) at x = 8.
    assert next(each["trilinear"][0] for each in grid["lookups"] if each["where"] == "between") == 0.4375


def test_voxels_of_an_index_are_numbered_by_tile_node_and_slot() -> None:
    # x counts most, z least; the root's tiles are sorted as unsigned numbers, so that those below 0 come last.
    (grid,) = facts_named("volume/index_half")["grids"]
    assert grid["voxels"][:4] == [[0, 0, 0], [0, 0, 1], [0, 1, 0], [0, 1, 1]]
    assert grid["voxels"][-1] == [-1, -1, -1]
    assert (grid["index"][0], grid["index"][-1]) == (1, 13)


def test_the_middle_of_a_picture_is_seen_along_the_pose() -> None:
    # Camera r_0 looks along -z from (0.5, -0.25, 4); pixel (0, 0) is 3.5 to the left and 2.5 up, at focal length 10.
    ray = facts_named("camera/shared")["cameras"][0]["rays"][0]
    length = math.sqrt(0.35**2 + 0.25**2 + 1)
    assert ray["direction"] == pytest.approx([-0.35 / length, 0.25 / length, -1 / length])
    assert ray["origin"] == [0.5, -0.25, 4]


def test_an_atlas_is_looked_up_by_hand() -> None:
    # Direction (2, 3, 6) / 7 is 2/11, 3/11, 6/11 of its sum: u = 13/22, v = 17/22; of 2 x 2 texels it is the last.
    # The texel's label is 3, whose texel (1, 1) has bytes (37 (36 + 9 + c)) mod 251.
    facts = facts_named("atlas/kmeans")
    bytes_ = [37 * (45 + channel) % 251 for channel in range(3)]
    first = facts["lookups"][0]
    assert facts["tiles"][3][1][1] == bytes_
    assert first["nearest"] == [byte / 255 for byte in bytes_]
    # The published metric takes texel int(uv (R - 1)): the first one.
    assert first["thesis"] == [37 * (36 + channel) % 251 / 255 for channel in range(3)]


def test_harmonics_by_hand() -> None:
    # Straight up only those of order 0 are left: half of sqrt(1 / pi), sqrt(3 / pi), sqrt(5 / pi).
    up = harmonics(9, [0.0, 0.0, 1.0])
    expected = {0: 0.28209479, 2: 0.48860251, 6: 0.63078313}
    assert up == pytest.approx([expected.get(i, 0) for i in range(9)])
    # svox keeps the phase: along x the fourth is below 0, along y the second.
    assert harmonics(4, [1.0, 0.0, 0.0])[3] == pytest.approx(-0.48860251)
    assert harmonics(4, [0.0, 1.0, 0.0])[1] == pytest.approx(-0.48860251)


def test_the_page_for_authors_of_readers_has_a_test_that_runs(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(HOME)
    blocks = re.findall(r"(?:^    .*\n|^\n)+", (HOME.parent / "readers.md").read_text(), re.MULTILINE)
    block = max(blocks, key=len)
    exec(textwrap.dedent(block), {})
    checked = int(capsys.readouterr().out.split()[0])
    assert checked == sum(len(case.facts["lookups"]) * npz_files(case) for case in CASES if "node_data" in case.facts)


def npz_files(case: Case) -> int:
    return sum(frozen.form.name == "svo.npz" for frozen in case.files.values())


# -- what the comparisons above are worth ----------------------------------------------------------------------
def test_a_wrong_number_is_found() -> None:
    tolerance = {"stored": 0.0, "computed": 1e-6}
    require_like({"a": [1.0], "lookups": [{"b": 1.0}]}, {"a": [1.0], "lookups": [{"b": 1.0000001}]}, tolerance)
    wrong: list[tuple[Any, Any]] = [
        ({"a": [1.0]}, {"a": [1.0000001]}),
        ({"lookups": [1.0]}, {"lookups": [1.1]}),
        ({"a": [1.0]}, {"a": [1.0, 1.0]}),
        ({"a": 1}, {"b": 1}),
        ({"a": float("nan")}, {"a": 1.0}),
        ({"a": True}, {"a": False}),
        ({"a": "x"}, {"a": "y"}),
        ({"a": None}, {"a": 1.0}),
    ]
    for found, expected in wrong:
        with pytest.raises(AssertionError):
            require_like(found, expected, tolerance)


def _repacked_png(data: bytes) -> bytes:
    file = io.BytesIO()
    with PIL.Image.open(io.BytesIO(data)) as picture:
        picture.save(file, "PNG", compress_level=0)
    return file.getvalue()


def _repacked_zst(data: bytes) -> bytes:
    content = zstandard.ZstdDecompressor().decompressobj().decompress(data)
    return zstandard.ZstdCompressor(level=19).compress(content)


def _plain_vdb(data: bytes) -> bytes:
    """Not packed at all."""
    bare = unpacked("a_zip.vdb", data)
    assert isinstance(bare, bytes)
    return bare


@pytest.mark.parametrize(
    ("name", "repack"),
    [
        ("picture/opaque.png", _repacked_png),
        ("picture/steps.depth.png", _repacked_png),
        ("atlas/grid/atlas_0.png", _repacked_png),
        ("octree/full_float32.svo.pb.zst", _repacked_zst),
        ("volume/fog_zip.vdb", _plain_vdb),
    ],
)
def test_another_packing_unpacks_to_the_same_and_other_content_does_not(
    name: str, repack: Callable[[bytes], bytes]
) -> None:
    frozen = (HOME / name).read_bytes()
    assert repack(frozen) != frozen
    assert unpacked(name, repack(frozen)) == unpacked(name, frozen)
    other = {
        "picture/opaque.png": "atlas/grid/labels_0.png",
        "picture/steps.depth.png": "picture/opaque.png",
        "atlas/grid/atlas_0.png": "atlas/affine/atlas_0.png",
        "octree/full_float32.svo.pb.zst": "volume/fog.nvdb.zst",
        "volume/fog_zip.vdb": "volume/half_zip.vdb",
    }[name]
    assert unpacked(name, (HOME / other).read_bytes()) != unpacked(name, frozen)


def test_no_lookup_hangs_on_a_rounding() -> None:
    """A reader that computes with float32 finds the same voxels."""
    for scene in volume_scenes().values():
        places = np.array([place for some in scene.places.values() for place in some])
        for shift in (0, 0.5):
            apart = np.abs(places + shift - np.rint(places + shift))
            assert apart.min() >= 1 / 16
