"""bench atlas: its figures are the program's own."""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path

import pytest

import nerfbake
from nerfbake import io
from nerfbake.bench import atlas
from nerfbake.bench.atlas import AtlasMethod
from nerfbake.bench.report import markdown
from nerfbake.kernels.maths.elementary import fibonacci


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_a_report_of_two_rows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    scene = nerfbake.sample_stage1(resolution=32)
    io.save_folder(tmp_path / "s", scene)
    monkeypatch.setattr(atlas, "VARIANTS", [AtlasMethod("kmeans", 16), AtlasMethod("kmeans", 10**6)])
    monkeypatch.setattr(atlas, "CLUSTERINGS", [("nerfbake", 8), ("KMeans", 8)])
    report = atlas.compare_atlases(str(tmp_path / "s"), rounds=1, progress=lambda text: nullcontext())
    good, bad = (dict(zip(atlas.COLUMNS, row, strict=True)) for row in report.tables[0].rows)
    baked = nerfbake.bake_atlas(scene.fields[0], clusters=16)
    error = nerfbake.measure_atlas_error(baked, scene.fields[0], directions=fibonacci(100))
    assert (good["MAE"], good["MSE"], good["thesis MAE"]) == (error.mae, error.mse, 11.151)
    assert "needs" in bad["atlas"]
    assert bad["MAE"] is None
    ours, theirs = (row[-1] for row in report.tables[1].rows)
    assert ours == pytest.approx(theirs, rel=0.15)
    assert "kmeans K=16" in markdown(report)
    assert atlas.chart_atlases(report, ".png").startswith(b"\x89PNG")
