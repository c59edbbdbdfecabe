"""Splats from .sog and from its folder, versions 1 and 2, judged by gaussforge."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Splats, load
from nerfbake.formats.splat import ply, sog
from tests.formats.splat.test_ply import assert_same, columns_of, converted
from tests.support.hostile import refused_as_it_is
from tests.support.splats import PARTS, TREE, reference, sog_files, sog_levels, sog_zip, splats, webp


def decoded(files: dict[str, bytes]) -> Splats:
    return sog.decode(memoryview(sog_zip(files)))


def write(folder: Path, files: dict[str, bytes]) -> Path:
    folder.mkdir(parents=True)
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


@pytest.mark.parametrize("version", [1, 2])
@pytest.mark.parametrize("degree", range(4))
def test_both_versions_are_near_what_was_packed(version: int, degree: int) -> None:
    scene = splats(130, degree=degree, antialiased=version == 2 and degree == 1)
    found = decoded(sog_files(scene, version=version))
    np.testing.assert_allclose(found.means, scene.means, atol=1e-3)
    logs = np.log(scene.scales)
    np.testing.assert_allclose(np.log(found.scales), logs, atol=0.51 / 255 * np.ptp(logs))
    assert np.abs((found.quats * scene.quats).sum(axis=1)).min() > 1 - 1e-4
    np.testing.assert_allclose(found.opacity, scene.opacity, atol=0.01)
    np.testing.assert_allclose(found.sh, scene.sh, atol=1.4 / 255 * 0.51)
    assert found.antialiased == scene.antialiased


def test_a_folder_is_read_as_its_archive_is(tmp_path: Path) -> None:
    files = sog_files(splats(20))
    folder = write(tmp_path / "scene", files)
    for place in (folder, folder / "meta.json"):
        assert_same(load(place, Splats), decoded(files), atol=0)
    (tmp_path / "a.sog").write_bytes(sog_zip(files))
    assert_same(load(tmp_path / "a.sog", Splats), decoded(files), atol=0)


def test_of_several_levels_the_finest_is_read(tmp_path: Path) -> None:
    folder = write(tmp_path / "scene", sog_levels(PARTS, TREE, environment="env/meta.json"))
    fine, coarse, sky = (decoded(sog_files(part)) for part in PARTS.values())
    for place in (folder, folder / "lod-meta.json"):
        found = load(place, Splats)
        expected = [fine.means[:4], fine.means[6:], coarse.means[2:], sky.means]
        assert np.array_equal(found.means, np.concatenate(expected))
        assert np.array_equal(found.sh[:4], fine.sh[:4])
        assert found.notes == ("of the levels of lod-meta.json, only the finest is read",)


def test_a_scene_without_an_environment_may_say_null() -> None:
    found = decoded(sog_levels(PARTS, TREE, environment=None))
    assert found.n == 4 + 3 + 3


def test_the_model_of_newer_writers_is_read() -> None:
    assert decoded(changed(lambda meta: meta.update(model="antialiased"))).antialiased
    assert not decoded(changed(lambda meta: meta.update(model="2dgs"))).antialiased


def test_the_logarithm_of_0_may_be_null_in_a_codebook() -> None:
    numbers = np.log(np.linspace(0.01, 0.02, 256)).tolist()
    whole = decoded(changed(lambda meta: meta["scales"].update(codebook=numbers)))
    found = decoded(changed(lambda meta: meta["scales"].update(codebook=[None, *numbers[1:]])))
    first = np.exp(numbers[1] + (numbers[1] - numbers[255]) / 255)  # as PlayCanvas' engine has it
    smallest = whole.scales == np.float32(0.01)
    assert smallest.any()
    np.testing.assert_allclose(found.scales, np.where(smallest, first, whole.scales), rtol=1e-6)


def test_few_splats_have_a_short_codebook() -> None:
    scene = splats(2, degree=0)
    files = sog_files(scene)
    pixels = np.full((1, 8, 4), 255, np.uint8)
    pixels[0, :2, :3] = np.arange(6).reshape(2, 3)  # each number is an entry of its own
    short = {**files, "scales.webp": webp(pixels)}
    found = decoded(changed(lambda meta: meta["scales"].update(codebook=np.log(scene.scales).ravel().tolist()), short))
    np.testing.assert_allclose(found.scales, scene.scales, rtol=1e-6)


# -- judges ----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("degree", range(4))
def test_we_read_what_gaussforge_writes_as_it_does(degree: int) -> None:
    gaussforge = pytest.importorskip("gaussforge")
    source = b"".join(ply.encode(splats(300, degree=degree)))
    data = bytes(gaussforge.GaussForge().convert(source, "ply", "sog")["data"])
    assert_same(sog.decode(memoryview(data)), columns_of(converted(data, "sog")), atol=1e-5)


@pytest.mark.parametrize("degree", range(4))
def test_gaussforge_reads_our_tests_files_as_we_do(degree: int) -> None:
    data = sog_zip(sog_files(splats(70, degree=degree)))
    assert_same(sog.decode(memoryview(data)), columns_of(converted(data, "sog")), atol=1e-5)


# -- hostile files ---------------------------------------------------------------------------------------------
SOUND = sog_files(splats(9, degree=1))


def changed(change: Callable[[dict[str, Any]], object], files: dict[str, bytes] = SOUND) -> dict[str, bytes]:
    name = "meta.json" if "meta.json" in files else "lod-meta.json"
    meta = json.loads(files[name])
    change(meta)
    return {**files, name: json.dumps(meta).encode()}


def bomb(edge: int) -> bytes:
    """A header that declares a picture of this edge."""
    bits = (edge - 1) | (edge - 1) << 14
    body = b"\x2f" + struct.pack("<I", bits) + bytes(20)
    return b"RIFF" + struct.pack("<I", 12 + len(body)) + b"WEBPVP8L" + struct.pack("<I", len(body)) + body


def extended(edge: int) -> bytes:
    """The same in an extended header, around a picture of one pixel."""
    small = webp(np.zeros((1, 1, 4), np.uint8))[12:]
    size = (edge - 1).to_bytes(3, "little")
    body = b"WEBPVP8X" + struct.pack("<II", 10, 0x10) + size + size + small
    return b"RIFF" + struct.pack("<I", len(body)) + body


TREES = sog_levels(PARTS, TREE)
LIES: dict[str, tuple[dict[str, bytes], str]] = {
    "2^32 splats": (
        changed(lambda meta: meta.update(count=2**32), {**SOUND, "means_l.webp": bomb(16384)}),
        "means_l.webp has 45 bytes for 4,294,967,296 splats; allowed: 256 splats a byte at most",
    ),
    "one splat too many": (
        changed(lambda meta: meta.update(count=17)),
        "meta.json: means.files[0] has 16 pixels; allowed: 17",
    ),
    "more than 2^32": (changed(lambda meta: meta.update(count=2**33)), "is 8589934592; allowed: a whole number from 0"),
    "no splats": (changed(lambda meta: meta.update(count=0)), "have no rows"),
    "version 3": (changed(lambda meta: meta.update(version=3)), "meta.json: version is 3; allowed: 2, or no version"),
    "a bomb": ({**SOUND, "quats.webp": bomb(16384)}, "quats.webp declares 16,384x16,384 pixels; allowed: a lossless"),
    "an extended bomb": ({**SOUND, "quats.webp": extended(1 << 24)}, "quats.webp declares 16,777,216x16,777,216"),
    "two sizes": ({**SOUND, "quats.webp": extended(16)}, "quats.webp "),
    "a PNG": ({**SOUND, "quats.webp": b"\x89PNG" + bytes(60)}, "quats.webp is not a lossless WebP"),
    "too few pixels": (
        {**SOUND, "sh0.webp": webp(np.zeros((1, 8, 4), np.uint8))},
        "meta.json: sh0.files[0] has 8 pixels; allowed: 9",
    ),
    "a way out": (
        changed(lambda meta: meta["quats"].update(files=["../quats.webp"])),
        "meta.json: quats.files[0] is '../quats.webp'; allowed: the name of a file beside meta.json",
    ),
    "a root": (changed(lambda meta: meta["quats"].update(files=["/etc/passwd"])), "quats.files[0] is '/etc/passwd'"),
    "no name": (changed(lambda meta: meta["quats"].update(files=[[]])), "quats.files[0] is 'a list'"),
    "no file": (changed(lambda meta: meta["quats"].update(files=["q.webp"])), "q.webp is missing"),
    "no means": (changed(lambda meta: meta.pop("means")), "meta.json: means is null; allowed: an object"),
    "a short codebook": (
        changed(lambda meta: meta["scales"].update(codebook=[0.0] * 255)),
        "scales.codebook has 255 numbers; allowed: 256, as its picture names",
    ),
    "an empty codebook": (
        changed(lambda meta: meta["scales"].update(codebook=[None])),
        "scales.codebook has 1 number; allowed: 256, as its picture names",
    ),
    "null in a codebook": (
        changed(lambda meta: meta["scales"].update(codebook=[0.0] * 255 + [None])),
        "scales.codebook[255] is null; allowed: a number",
    ),
    "a word for a codebook": (
        changed(lambda meta: meta["scales"].update(codebook="abc")),
        "scales.codebook is not a table of numbers",
    ),
    "a huge codebook": (changed(lambda meta: meta["scales"].update(codebook=[1e3] * 256)), "9 rows of 9 that cannot"),
    "NaN": ({**SOUND, "meta.json": SOUND["meta.json"].replace(b'"count": 9', b'"count": NaN')}, "shN.count is NaN"),
    "labels": (
        changed(lambda meta: meta["shN"].update(count=3)),
        "meta.json: shN.files[1] names entry 8; allowed: below 3, the palette's",
    ),
    "bands": (changed(lambda meta: meta["shN"].update(bands=2)), "shN.files[0] has 192x1 pixels"),
    "255 bands": (changed(lambda meta: meta["shN"].update(bands=255)), "bands is 255; allowed: a whole number from 1"),
    "no tree": (changed(lambda meta: meta.update(tree=3), TREES), "lod-meta.json: tree has a number"),
    "a way out of a level": (
        changed(lambda meta: meta.update(filenames=["../../x/meta.json"] * 3), TREES),
        "lod-meta.json: filenames has '../../x/meta.json'; allowed: FOLDER/meta.json below this folder",
    ),
    "no such file": (
        changed(lambda meta: meta["tree"]["children"][0]["lods"]["0"].update(file=9), TREES),
        "lods.file is 9; allowed: a whole number from 0 to 2",
    ),
    "too many rows": (
        changed(lambda meta: meta["tree"]["children"][0]["lods"]["0"].update(count=10), TREES),
        "lods has rows up to 10 of 9 in 0_0/meta.json",
    ),
}


@pytest.mark.parametrize("lie", LIES)
def test_a_lying_sog_is_one_line(lie: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    files, told = LIES[lie]
    assert told in refused_as_it_is(tmp_path / "bad.sog", sog_zip(files), capsys)


def test_repeated_ranges_are_counted_before_they_are_copied(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    leaf = {"lods": {"0": reference(0, 0, 3000)}}
    files = sog_levels({"a": splats(3000, degree=0)}, {"children": [leaf] * 30_000})
    assert "the splats of a level need" in refused_as_it_is(tmp_path / "bad.sog", sog_zip(files), capsys)
