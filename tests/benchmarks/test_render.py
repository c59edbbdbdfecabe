"""The render benchmark."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from benchmarks import render
from nerfbake import build_field, build_octree, orbit_cameras, save
from tests.support.scenes import n3tree


def test_a_row_renders_every_camera_and_says_how_far_it_is_from_the_first(tmp_path: Path) -> None:
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4")
    save(tmp_path / "a.npz", tree)
    save(tmp_path / "b.svo.npz", build_octree(tree, resolution=2))
    save(tmp_path / "c.json", orbit_cameras(build_field(tree), frames=3, width=20, height=20))
    shared: dict[str, Any] = {"cameras": str(tmp_path / "c.json"), "edge": 24, "lookup": "nearest"}
    shared["truth"] = str(tmp_path / "truth.npy")
    first, other = (render.rendering(str(tmp_path / name), **shared) for name in ("a.npz", "b.svo.npz"))
    told = first.check(first.run())
    assert (told["frames"], told["psnr"]) == (3, 100)
    assert np.load(tmp_path / "truth.npy").shape == (3, 24, 24, 3)
    assert told["cells"] == (2 * 8 + 15 * 13) * 4
    assert 5 < other.check(other.run())["psnr"] < 60


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.usefixtures("in_this_process")
def test_the_report_has_every_structure(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(render, "EDGES", (16,))
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4")
    views = orbit_cameras(build_field(tree), frames=2, width=16, height=16)
    report = render.compare_rendering(tree, "small", views, rounds=1, progress=lambda _: nullcontext())
    rows = [dict(zip(render.COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    names = ["N3Tree", "octree", "VDB, density and sh", "VDB index, float16"]
    assert [row["structure"] for row in rows] == 2 * names
    assert all(row["frames a second"] > 0 for row in rows)
    assert [row["PSNR dB"] > 60 for row in rows] == 4 * [True] + 4 * [False]
    assert render.chart_rendering(report, ".svg").startswith(b"<?xml")
