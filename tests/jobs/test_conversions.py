"""The same octree or the same volume in another file."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import SparseVoxelOctree, VdbTree, Volume, load
from nerfbake.errors import NerfbakeError, UsageError
from nerfbake.jobs import Choice, Target, bake_volume, convert_file
from tests.jobs.listener import Listener
from tests.support.scenes import assert_same_octree


@pytest.mark.usefixtures("folder")
def test_an_octree_by_way_of_a_volume_is_the_same_octree() -> None:
    bake_volume("a.svo.pb", "a.nvdb", grids="index")
    octree = convert_file("a.nvdb", "b.svo.npz")
    assert isinstance(octree, SparseVoxelOctree)
    assert_same_octree(octree, load("a.svo.pb", SparseVoxelOctree))
    assert_same_octree(load("b.svo.npz", SparseVoxelOctree), octree)


@pytest.mark.usefixtures("folder")
def test_a_volume_in_another_format(listener: Listener) -> None:
    bake_volume("a.npz", "a.vdb", grids="density,Cd")
    volume = convert_file("a.vdb", Target("b", to="nvdb"), choice=Choice(("density",)), half=True, steps=listener)
    assert isinstance(volume, Volume)
    (grid,) = load("b", Volume).grids
    assert isinstance(grid, VdbTree)
    assert grid.name == "density"
    assert listener.phases == ["reading a.vdb", "choosing grids", "rounding", "writing b"]
    assert any("Fp16" in line for line in listener.said)


def test_what_does_not_go_together_is_told(folder: Path) -> None:
    with pytest.raises(UsageError, match="a volume has no child slots"):
        convert_file("none", "b.vdb", layout="full")
    with pytest.raises(UsageError, match="--half is for volumes"):
        convert_file("a.svo.pb", "b.svo.npz", half=True)
    bake_volume("a.npz", "a.vdb", grids="density,Cd")
    with pytest.raises(NerfbakeError, match=r"^a\.vdb: "):
        convert_file("a.vdb", "b.svo.npz", choice=Choice(("density", "Cd")))
    assert not list(folder.glob("b*"))
