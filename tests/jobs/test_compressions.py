"""Compressing from files to files."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import N3Tree, SparseVoxelOctree, build_field, load, memory_limit, orbit_cameras, render_field, save
from nerfbake.errors import UsageError
from nerfbake.jobs import CompressionGoal, GroundTruth, compress_file
from tests.jobs.listener import Listener


@pytest.mark.usefixtures("fewer_rays")
def test_what_is_found_is_what_is_written_and_told(folder: Path, listener: Listener) -> None:
    found = compress_file("a.npz", "a.svoq", goal=CompressionGoal(max_loss=0.2), steps=listener)
    assert found.size == (folder / "a.svoq").stat().st_size
    assert found.loss <= 0.2
    assert listener.phases[-2:] == ["compressing", "writing a.svoq"]
    assert listener.told[0].endswith("leaves weighed")
    assert any(told.endswith(f"{found.size:,} bytes, {found.loss:.3f} dB") for told in listener.told)
    assert load("a.svoq", SparseVoxelOctree).problems() == []


@pytest.mark.usefixtures("folder")
def test_wrong_arguments_are_told_before_anything_is_read() -> None:
    with pytest.raises(UsageError, match="`max_loss` and `max_size` are two goals"):
        compress_file("none", "a.svoq", goal=CompressionGoal(max_loss=1, max_size=1))
    with pytest.raises(UsageError, match="`truth` has no cameras"):
        compress_file("none", "a.svoq", photographs=GroundTruth(truth="."))
    with pytest.raises(UsageError, match=r"allowed: \.svoq"):
        compress_file("none", "a.svo.pb")


@pytest.mark.usefixtures("fewer_rays")
def test_photographs_are_read_one_after_the_other(folder: Path) -> None:
    scene = load("a.npz", N3Tree)
    field = build_field(scene)
    views = orbit_cameras(field, frames=12, width=640, height=640)
    save("around.json", views)
    (folder / "truth").mkdir()
    for view in views.cameras:
        save(folder / "truth" / f"{view.name}.png", render_field(field, view))
    photographs = GroundTruth(cameras="around.json", truth="truth")
    all_at_once = 12 * 640 * 640 * 4 * 5
    with memory_limit(2 * all_at_once // 3):
        found = compress_file("a.npz", "a.svoq", goal=CompressionGoal(step=0.2), photographs=photographs)
    assert found.measured
    assert found.views == 12
