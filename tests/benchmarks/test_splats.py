"""The benchmark of splats on a small scene."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import splats as benchmark
from benchmarks.aims import SPLAT_OCTREES
from benchmarks.scenes import Scenes
from nerfbake import save
from nerfbake.jobs import splat_fields
from tests.support.splats import ball_of_splats


def test_every_row_has_its_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "splats").mkdir()
    save(tmp_path / "splats" / "biker.spz", ball_of_splats())
    monkeypatch.setattr(benchmark, "RESOLUTIONS", (16,))
    for module, name, value in (
        (benchmark, "PICTURE", 48),
        (benchmark, "EDGE", 48),
        (benchmark, "JUDGES", 2),
        (splat_fields, "_FRAMES", 8),
        (splat_fields, "_EDGE", 48),
        (splat_fields, "_JUDGES", 1),
    ):
        monkeypatch.setattr(module, name, value)
    found = benchmark.reports(Scenes(tmp_path, tmp_path), rounds=1)["splats"]
    assert isinstance(found, list)
    files, voxels, aims = found[0].tables
    assert files.rows[0][:3] == ["biker.spz", 400, 0]
    assert files.rows[1][0] == "biker.compressed.ply: not there"
    assert [row[:2] for row in voxels.rows] == [["16^3", False], ["16^3", True]]
    assert float(voxels.rows[1][4]) > float(voxels.rows[0][4]) > 15
    assert len(aims.rows) == 2 + 2 * len(SPLAT_OCTREES)
    assert aims.rows[-1][2:] == [None, False]
