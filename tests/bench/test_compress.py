"""`nerfbake bench compress`."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import build_field, build_octree, orbit_cameras, render_field, sample_n3tree, save
from nerfbake.bench import compress
from tests.bench.conftest import quiet
from tests.conftest import Shell


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process", "fewer_rays")
def test_the_report_has_the_curve_and_every_contender(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(compress, "LOSSES", (0.2, 2.0))
    octree = build_octree(sample_n3tree(resolution=16, basis="SH4"))
    field = build_field(octree)
    views = orbit_cameras(field, frames=2, width=24, height=24)
    save(tmp_path / "views.json", views)
    for view in views.cameras:
        save(tmp_path / f"{view.name}.png", render_field(field, view))
    photographs = {"cameras": str(tmp_path / "views.json"), "truth": str(tmp_path)}
    report = compress.compare_compression(octree, "small", **photographs, rounds=1, progress=quiet)
    rows = {row[0]: dict(zip(compress.COLUMNS, row, strict=True)) for row in report.tables[0].rows}
    assert list(rows)[:4] == ["svoq range, 0.2 dB", "svoq range, 2 dB", "svoq deflate, 0.2 dB", "svoq deflate, 2 dB"]
    assert list(rows)[4:] == list(compress.contenders())
    assert rows["svoq range, 2 dB"]["MB"] < rows["svoq range, 0.2 dB"]["MB"] < rows["float16, xz"]["MB"]
    for loss in (0.2, 2.0):
        assert 0.8 * loss < rows[f"svoq range, {loss:g} dB"]["predicted dB"] <= loss
    assert rows["float16, xz"]["predicted dB"] < 1e-3
    assert rows["palette of 256"]["predicted dB"] > rows["median cut to 65,536"]["predicted dB"]
    assert all(row["measured dB"] is not None for row in rows.values())
    assert compress.chart_compression(report, ".svg").startswith(b"<?xml")


def test_what_cannot_be_compressed_is_one_line(shell: Shell, tmp_path: Path) -> None:
    save(tmp_path / "a.npz", sample_n3tree(resolution=8))
    for arguments, said in (
        (["a.npz", "--truth", "."], "--truth has no cameras"),
        (["a.npz", "--cameras", "b.json"], "allowed: --cameras with --truth"),
        (["a.npz", "--plot", "x.pdf"], "is not that of a chart; allowed: .png, .svg"),
    ):
        done = shell("bench", "compress", *arguments)
        assert done.stderr.decode().count("\n") == 1
        assert said in done.stderr.decode()
