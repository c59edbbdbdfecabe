"""The fit benchmark."""

from __future__ import annotations

from pathlib import Path

import pytest

from benchmarks import fit
from nerfbake.errors import NerfbakeError
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.steps import SILENT
from tests.bench.conftest import quiet
from tests.support.photographs import write_scene


@pytest.mark.long
@pytest.mark.usefixtures("in_this_process")
def test_the_report_has_every_table(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fit, "EDGE", 8)
    monkeypatch.setattr("nerfbake.bench.access.rays.RAYS_EDGE", 8)
    source = str(write_scene(tmp_path / "capture", frames=8))
    views = read_photographs(SILENT, Source(source)).held_out
    report = fit.compare_fits(source, views, schedules=("fast",), resolution=32, rounds=1, progress=quiet)
    fits, curve, paper, table4, merging, rays = report.tables
    (row,) = (dict(zip(fit.FITS, row, strict=True)) for row in fits.rows)
    assert row["fit"] == "fast"
    assert float(row["PSNR dB"]) > 15  # from eight pictures
    assert row["peak MB"] > 50
    assert curve.rows[-1][-2:] == [row["PSNR dB"], "the written file"]
    assert all(earlier[1] <= later[1] for earlier, later in zip(curve.rows, curve.rows[1:], strict=False))
    rows = [dict(zip(fit.COLUMNS, row, strict=True)) for row in table4.rows]
    names = [structure.name for structure in fit.STRUCTURES]
    assert [each["structure"] for each in rows] == ["PlenOctree, as fit wrote it", *names, *names]
    own, merged, half, packed = rows[0], rows[2], rows[3], rows[4]
    assert own["PSNR dB"] == row["PSNR dB"]
    assert abs(float(merged["change dB"])) < 0.02
    assert abs(float(half["change dB"])) < 0.05
    assert merged["MB"] > half["MB"] > packed["MB"]
    assert all(each["frames a second"] > 0 for each in rows)
    assert [len(table.rows) for table in (paper, merging, rays)] == [13, 4, 2]
    assert fit.chart_fits(report, ".svg").startswith(b"<?xml")


def test_a_fit_that_fails_says_why(tmp_path: Path) -> None:
    with pytest.raises(NerfbakeError, match="no-such-preset"):
        fit.fitted("nowhere", tmp_path, "no-such-preset", 2, 32)
