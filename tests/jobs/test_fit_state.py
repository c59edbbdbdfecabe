"""Checkpoints of a fit: which ones it goes on from."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from nerfbake import Camera, Cameras, Views
from nerfbake.errors import InvalidFile
from nerfbake.jobs.fit_state import CheckpointWriter
from nerfbake.scene.sparse_points import SparsePoints

STATE: Any = SimpleNamespace(arrays=lambda: {"at": np.zeros(3)})


def writer(folder: Path, points: float | None = None) -> CheckpointWriter:
    """A fit to one picture whose program found a point at this x."""
    found = None if points is None else SparsePoints(np.array([[points, 0.0, 0.0]]))
    cameras = Cameras((Camera(4, 3, 5.0, np.eye(4), "front"),), points=found)
    views = Views(cameras, (np.zeros((3, 4, 4), np.uint8),), (1.0, 1.0, 1.0), True)
    return CheckpointWriter(str(folder), {"seed": "0"}, views)


def test_points_are_part_of_what_was_fitted(tmp_path: Path) -> None:
    writer(tmp_path, 1.0).keep(STATE, worked=1.0, passed=1.0, curve=[], devices=["cpu"])
    assert writer(tmp_path, 1.0).last() is not None
    for other in (None, 2.0):
        with pytest.raises(InvalidFile, match="the fit had other pictures, cameras or points; allowed: the same, or"):
            writer(tmp_path, other).last()


def test_a_checkpoint_of_a_program_that_started_elsewhere_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as before:
        before.setattr("nerfbake.jobs.fit_state._VERSION", 4)
        writer(tmp_path).keep(STATE, worked=1.0, passed=1.0, curve=[], devices=["cpu"])
    with pytest.raises(
        InvalidFile, match=r"the fit's checkpoint format was 4; allowed: the same as now \(5\), or another"
    ):
        writer(tmp_path).last()
