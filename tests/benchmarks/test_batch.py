"""The table of engines that run many scenes."""

from __future__ import annotations

import pytest

from benchmarks import batch
from benchmarks.scenes import Scenes


@pytest.mark.long
@pytest.mark.slow
def test_every_engine_writes_what_the_loop_writes(scenes: Scenes, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(batch, "SCENES", 2)
    monkeypatch.setattr(batch, "ENGINES", [each for each in batch.ENGINES if not each.module and each.jobs == 2])
    (report,) = batch.reports(scenes, rounds=1)["batch"]
    (table,) = report.tables
    assert [row[:2] for row in table.rows] == [["make", 2], ["nerfbake batch", 2]]
    assert [row[-1] for row in table.rows] == [True, True]
