"""Splats written as .sog and as its folder, judged by gaussforge, and what the codebooks lose."""

from __future__ import annotations

import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Splats, load, measure_splats, save
from nerfbake.errors import OutputError, UsageError
from nerfbake.formats.splat import sog, sog_writer
from nerfbake.io import save_folder
from nerfbake.jobs import Target, convert_splats
from nerfbake.jobs.splat_choice import SplatChoice
from tests.formats.splat.test_ply import assert_same, columns_of, converted
from tests.support.splats import splats


def written(scene: Splats) -> bytes:
    return b"".join(sog.encode(scene))


def assert_near(found: Splats, scene: Splats) -> None:
    """As near as the format's steps are, for few splats."""
    np.testing.assert_allclose(found.means, scene.means, atol=3e-4)
    np.testing.assert_allclose(np.log(found.scales), np.log(scene.scales), atol=0.03)
    assert np.abs((found.quats * scene.quats).sum(axis=1)).min() > 1 - 1e-4
    np.testing.assert_allclose(found.opacity, scene.opacity, atol=0.5 / 255 + 1e-6)
    np.testing.assert_allclose(found.sh[:, 0], scene.sh[:, 0], atol=0.01)
    np.testing.assert_allclose(found.sh[:, 1:], scene.sh[:, 1:], atol=0.01)
    assert found.antialiased == scene.antialiased


@pytest.mark.parametrize("degree", range(4))
def test_there_and_back_along_a_curve(degree: int, tmp_path: Path) -> None:
    scene = splats(120, degree=degree, antialiased=degree == 1)
    save(tmp_path / "a.sog", scene)
    ordered = sog_writer.in_order(scene)
    assert_near(load(tmp_path / "a.sog", Splats), ordered)
    assert sorted(map(tuple, ordered.means.tolist())) == sorted(map(tuple, scene.means.tolist()))
    steps = [np.linalg.norm(np.diff(each.means, axis=0), axis=1).mean() for each in (ordered, scene)]
    assert steps[0] < 0.6 * steps[1]
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert all(member.compress_type == zipfile.ZIP_STORED for member in archive.infolist())
        assert {member.date_time[0] for member in archive.infolist()} == {1980}


def test_a_far_splat_leaves_the_others_along_the_curve() -> None:
    scene = splats(400, degree=0)
    far = scene.means.copy()
    far[7] *= 100_000
    ordered, moved = (sog_writer.morton_order(means) for means in (scene.means, far))
    steps = [
        np.linalg.norm(np.diff(scene.means[order], axis=0), axis=1).mean()
        for order in (moved[moved != 7], ordered, np.arange(400))
    ]
    assert steps[0] < 1.1 * steps[1] < 0.6 * steps[2]


@pytest.mark.parametrize("degree", [0, 3])
def test_gaussforge_reads_what_we_write(degree: int) -> None:
    data = written(splats(60, degree=degree))
    assert_same(columns_of(converted(data, "sog")), sog.decode(memoryview(data)), atol=1e-5)


def test_one_splat_and_equal_ones_are_written() -> None:
    one = splats(1, degree=1)
    assert_near(sog.decode(memoryview(written(one))), one)
    rows: dict[str, Any] = {
        name: np.repeat(getattr(one, name), 9, axis=0) for name in ("means", "scales", "quats", "opacity", "sh")
    }
    assert sog.decode(memoryview(written(replace(one, **rows)))).n == 9


def test_convert_compares_row_by_row_although_the_order_changes(tmp_path: Path) -> None:
    scene = splats(200, degree=2)
    save(tmp_path / "a.ply", scene)
    found = convert_splats(tmp_path / "a.ply", tmp_path / "b.sog")
    loss = measure_splats(sog_writer.in_order(scene), found)
    assert loss.means.largest < 1e-3
    assert measure_splats(scene, found).means.largest > 0.1


def test_a_palette_has_as_many_entries_as_it_may(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sog_writer, "_PALETTE", 256)
    scene = splats(4000, degree=2)
    files = sog_writer.files_of(scene)
    assert b'"count": 192, "bands": 2' in files["meta.json"]  # 3 x 64: 1,024 splats for 64 entries
    found, ordered = sog.splats_in({name: memoryview(data) for name, data in files.items()}), sog_writer.in_order(scene)
    error = np.sqrt(((found.sh[:, 1:] - ordered.sh[:, 1:]) ** 2).mean())
    assert error < 0.95 * ordered.sh[:, 1:].std()  # noise in 24 dimensions can hardly be told by 192 rows


def test_a_folder_has_the_files_of_the_archive(tmp_path: Path) -> None:
    save(tmp_path / "a.ply", splats(90, degree=1))
    convert_splats(tmp_path / "a.ply", tmp_path / "a.sog")
    found = convert_splats(tmp_path / "a.ply", tmp_path / "scene" / "meta.json")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {path.name: path.read_bytes() for path in (tmp_path / "scene").iterdir()}
        assert files == {name: archive.read(name) for name in archive.namelist()}
    assert_same(found, load(tmp_path / "a.sog", Splats), atol=0)


def test_a_folder_that_is_read_or_has_other_files_is_not_replaced(tmp_path: Path) -> None:
    scene, out = tmp_path / "scene", Target(str(tmp_path / "scene" / "meta.json"), force=True)
    save_folder(scene, splats(9, degree=0))
    with pytest.raises(OutputError, match="contains the input"):
        convert_splats(scene / "meta.json", out)
    save(tmp_path / "a.ply", splats(8, degree=0))
    assert convert_splats(tmp_path / "a.ply", out).n == 8
    (scene / "mine.txt").write_text("mine")
    with pytest.raises(OutputError, match=r"has 'mine.txt', which nerfbake did not write"):
        convert_splats(tmp_path / "a.ply", out)
    save(tmp_path / "far.ply", replace(splats(8, degree=0), origin=np.array([4e5, 5e6, 0])))
    assert not convert_splats(tmp_path / "far.ply", tmp_path / "far" / "meta.json").origin.any()
    with pytest.raises(UsageError, match="sog_folder takes no option 'half'"):
        convert_splats(tmp_path / "a.ply", tmp_path / "b" / "meta.json", choice=SplatChoice(half=True))
