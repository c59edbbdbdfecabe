"""Octrees from files to files."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import N3Tree, SparseVoxelOctree, build_octree, cut_octree, load
from nerfbake.errors import BudgetMissed, OutputError, UsageError
from nerfbake.jobs import Budget, Target, bake_lod, bake_octree
from tests.jobs.listener import Listener
from tests.support.scenes import assert_same_octree


def test_what_is_given_is_what_is_written(folder: Path, listener: Listener) -> None:
    octree = bake_octree("a.npz", "b.svo.npz", resolution=3, dtype="float16", steps=listener)
    assert_same_octree(load("b.svo.npz", SparseVoxelOctree), octree)
    assert_same_octree(octree, build_octree(load("a.npz", N3Tree), resolution=3, dtype="float16"))
    assert listener.phases == ["reading a.npz", "building the octree", "writing b.svo.npz"]
    assert listener.said == [f"b.svo.npz: {octree}, {(folder / 'b.svo.npz').stat().st_size:,} bytes"]


@pytest.mark.usefixtures("folder")
def test_a_level_of_detail() -> None:
    cut = bake_lod("a.svo.pb", Target("b", to="svo.npz"), level=1, no_child=-1)
    assert_same_octree(cut, cut_octree(load("a.svo.pb", SparseVoxelOctree), level=1))
    assert_same_octree(load("b", SparseVoxelOctree), cut)


def test_an_output_that_cannot_be_is_told_before_anything_is_read(folder: Path) -> None:
    with pytest.raises(UsageError, match="has no file extension for an octree"):
        bake_octree("none", "b.obj")
    with pytest.raises(UsageError, match="has no file extension for an octree"):
        bake_lod("none", "b.obj", level=1)
    with pytest.raises(UsageError, match=r"svo\.npz takes no option 'profile'"):
        bake_octree("none", Target("b.svo.npz", profile="bulk"))
    with pytest.raises(OutputError, match="exists already"):
        bake_lod("none", "a.svo.pb", level=1)
    with pytest.raises(UsageError, match="`min_psnr` needs an output file"):
        bake_octree("none", Target("-", to="svo.pb"), budget=Budget(min_psnr=1))
    assert sorted(path.name for path in folder.iterdir()) == ["a.npz", "a.svo.pb", "cameras.json"]


def test_a_missed_budget_leaves_what_was_written_as_rejected(folder: Path) -> None:
    with pytest.raises(BudgetMissed, match=r"^b.svo.pb: the picture has a mean PSNR of") as missed:
        bake_octree("a.npz", "b.svo.pb", resolution=1, budget=Budget(50, "cameras.json"))
    assert missed.value.exit_code == 3
    assert not (folder / "b.svo.pb").exists()
    assert load("b.svo.pb.rejected", SparseVoxelOctree).size == (1, 1, 1)
    with pytest.raises(BudgetMissed):
        bake_lod("a.svo.pb", "c.svo.pb", level=0, budget=Budget(50, "cameras.json"))
    assert not (folder / "c.svo.pb").exists()
