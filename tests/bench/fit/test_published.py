"""The published figures agree with what their sources say about them elsewhere."""

from __future__ import annotations

import pytest

from nerfbake.bench.fit.published import PUBLISHED, SCENES, PublishedMethod, plenvdb_table


def method(name: str) -> PublishedMethod:
    (found,) = (each for each in PUBLISHED if each.name == name)
    return found


@pytest.mark.parametrize(
    ("name", "psnr", "minutes"), [("instant-ngp", 32.20, 143), ("TensoRF", 33.17, 647), ("3DGS", 33.31, 366)]
)
def test_means_over_all_scenes_are_those_that_were_printed(name: str, psnr: float, minutes: int) -> None:
    """NerfBaselines prints the means, too: PSNR, and 2m 23s, 10m 47s, 6m 6s."""
    found = method(name)
    assert sum(found.decibels(scene) or 0 for scene in SCENES) / 8 == pytest.approx(psnr, abs=0.006)
    assert round(sum(found.minutes(scene) or 0 for scene in SCENES) / 8 * 60) == minutes


def test_what_was_not_published_is_none() -> None:
    assert method("3DGS-MCMC").decibels("drums") is None
    assert method("3DGS-MCMC").minutes("chair") is None
    assert method("PlenOctrees").minutes("chair") is None
    assert method("TensoRF").megabytes("chair") is None
    assert method("Plenoxels").minutes("ship") == 17 + 50 / 60


def test_the_table_of_plenvdb_is_as_it_was_printed() -> None:
    table = plenvdb_table()
    rows = {row[0]: row[1:] for row in table.rows}
    assert table.columns[1:] == list(SCENES)
    assert len(rows) == 13
    assert rows["training min:s, DVGO"][:2] == ["4:03", "4:07"]
    assert rows["frames a second, PlenVDB"] == [30, 20, 25, 14, 18, 11, 42, 6]
    assert rows["MB, Plenoxels"][-1] == 1331
    assert rows["PSNR dB, PlenVDB"][4] == "34.66"
