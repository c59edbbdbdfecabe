"""Volumes from files to files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import VdbTree, Volume, load
from nerfbake.errors import BudgetMissed, UsageError
from nerfbake.jobs import Budget, Target, bake_volume
from tests.jobs.listener import Listener


@pytest.mark.parametrize("source", ["a.npz", "a.svo.pb"])
@pytest.mark.usefixtures("folder")
def test_a_tree_and_its_octree_make_the_same_volume(source: str, listener: Listener) -> None:
    volume = bake_volume(
        source, "b.vdb", grids="density,sh", steps=listener, budget=Budget(min_psnr=50, cameras="cameras.json")
    )
    read = load("b.vdb", Volume)
    assert [grid.name for grid in read.grids] == [grid.name for grid in volume.grids]
    for one, other in zip(read.grids, volume.grids, strict=True):
        assert isinstance(one, VdbTree)
        assert isinstance(other, VdbTree)
        np.testing.assert_array_equal(one.values, other.values)
    phases = [phase for phase in listener.phases if phase != "building the octree"]
    assert phases[:3] == [f"reading {source}", "building the grids", "writing b.vdb"]
    assert listener.said[-1].endswith(f"dB against {source}")


@pytest.mark.usefixtures("folder")
def test_grids_are_those_that_are_usual_for_the_format(listener: Listener) -> None:
    assert [grid.name for grid in bake_volume("a.npz", "a.vdb.npz").grids] == ["density", "Cd"]
    assert [grid.name for grid in bake_volume("a.npz", "a.nvdb", half=True, steps=listener).grids] == ["density"]
    assert any("Fp16" in line for line in listener.said)


def test_what_arguments_alone_can_tell_is_told_before_anything_is_read(folder: Path) -> None:
    with pytest.raises(UsageError, match="`grids` are 'fog'"):
        bake_volume("none", "b.vdb", grids="fog")
    with pytest.raises(UsageError, match="`min_psnr` needs an output file"):
        bake_volume("none", Target("-", to="vdb"), budget=Budget(min_psnr=1))
    with pytest.raises(UsageError, match="`resolution` has no effect on an octree"):
        bake_volume("a.svo.pb", "b.vdb", resolution=3)
    assert not (folder / "b.vdb").exists()


def test_a_missed_budget_leaves_what_was_written_as_rejected(folder: Path) -> None:
    with pytest.raises(BudgetMissed):
        bake_volume("a.npz", "b.vdb", grids="density", budget=Budget(min_psnr=90, cameras="cameras.json"))
    assert [path.name for path in folder.glob("b.vdb*")] == ["b.vdb.rejected"]
