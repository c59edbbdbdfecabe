"""The benchmark of splats on a small scene."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import splats as benchmark
from benchmarks.aims import SPLAT_FILES, SPLAT_OCTREES
from benchmarks.scenes import Scenes
from nerfbake import sample_n3tree, save
from nerfbake.jobs import SplatsOptions, SplatsViews, splat_voxels
from tests.support.photographs import write_scene
from tests.support.splats import ball_of_splats


@pytest.mark.slow
def test_every_row_has_its_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "splats").mkdir()
    save(tmp_path / "splats" / "biker.spz", ball_of_splats())
    monkeypatch.setattr(benchmark, "RESOLUTIONS", (16,))
    for module, name, value in (
        (benchmark, "PICTURE", 48),
        (benchmark, "EDGE", 48),
        (benchmark, "JUDGES", 2),
        (splat_voxels, "_FRAMES", 8),
        (splat_voxels, "_EDGE", 48),
        (splat_voxels, "_JUDGES", 1),
    ):
        monkeypatch.setattr(module, name, value)
    chair = Scenes(tmp_path, tmp_path).chair
    chair.parent.mkdir(parents=True)
    save(chair, sample_n3tree(resolution=16, basis="SH1"))
    write_scene(Scenes(tmp_path, tmp_path).capture, frames=8, edge=16)
    monkeypatch.setattr(benchmark, "SPLATS", SplatsOptions(splats=300, epochs=1))
    monkeypatch.setattr(benchmark, "SplatsViews", lambda views: SplatsViews(views=views, frames=6, edge=32))
    found = benchmark.reports(Scenes(tmp_path, tmp_path), rounds=1)["splats"]
    assert isinstance(found, list)
    files, voxels, baked, aims = found[0].tables
    assert [row[0] for row in baked.rows] == list(SPLAT_FILES)
    assert all(row[1] <= 300 and float(row[4]) > 10 for row in baked.rows)
    assert files.rows[0][:3] == ["biker.spz", 400, 0]
    assert files.rows[1][0] == "biker.compressed.ply: not there"
    assert [row[:2] for row in voxels.rows] == [["16^3", False], ["16^3", True]]
    assert float(voxels.rows[1][4]) > float(voxels.rows[0][4]) > 15
    assert len(aims.rows) == 2 + 2 * len(SPLAT_OCTREES) + 2 * len(SPLAT_FILES)
    assert aims.rows[5][2:] == [None, False]
