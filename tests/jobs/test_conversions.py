"""The same octree or the same volume in another file."""

from __future__ import annotations

from pathlib import Path

import pytest

from nerfbake import SparseVoxelOctree, VdbTree, Volume, load, save
from nerfbake.errors import InvalidScene, NerfbakeError, OutputError, UsageError
from nerfbake.jobs import GridChoice, Target, bake_volume, convert_file, split_volume
from tests.jobs.listener import Listener
from tests.support.scenes import assert_same_octree
from tests.support.vdb_readers import tree, volume

VOXELS = [[0, 0, 0], [1, 2, 3], [9, 0, 5]]


def smoke(path: Path, *names: str) -> Volume:
    """A velocity, which has three channels, and then grids of one channel."""
    made = volume(tree(VOXELS, channels=3, name="velocity"), *(tree(VOXELS, name=name) for name in names))
    save(path, made)
    return made


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
    volume = convert_file("a.vdb", Target("b", to="nvdb"), choice=GridChoice(("density",)), half=True, steps=listener)
    assert isinstance(volume, Volume)
    (grid,) = load("b", Volume).grids
    assert isinstance(grid, VdbTree)
    assert grid.name == "density"
    assert listener.phases == ["reading a.vdb", "choosing grids", "rounding", "writing b"]
    assert any("Fp16" in line for line in listener.said)


def test_what_does_not_go_together_is_told(folder: Path) -> None:
    with pytest.raises(UsageError, match="a volume has no child slots"):
        convert_file("none", "b.vdb", layout="full")
    with pytest.raises(UsageError, match="`half` is for volumes"):
        convert_file("a.svo.pb", "b.svo.npz", half=True)
    bake_volume("a.npz", "a.vdb", grids="density,Cd")
    with pytest.raises(NerfbakeError, match=r"^a\.vdb: "):
        convert_file("a.vdb", "b.svo.npz", choice=GridChoice(("heat",)))
    assert not list(folder.glob("b*"))


def test_an_octree_is_made_of_the_density_wherever_it_stands(tmp_path: Path, listener: Listener) -> None:
    path = tmp_path / "smoke.vdb"
    smoke(path, "density", "temperature")
    octree = convert_file(path, tmp_path / "all.svo.npz", steps=listener)
    alone = convert_file(path, tmp_path / "alone.svo.npz", choice=GridChoice(("density",)))
    assert isinstance(octree, SparseVoxelOctree)
    assert isinstance(alone, SparseVoxelOctree)
    assert_same_octree(octree, alone)
    assert f"{path}: the octree gets the density only, without velocity, temperature" in listener.said


def test_a_density_must_be_named_where_none_has_the_name(tmp_path: Path) -> None:
    smoke(tmp_path / "smoke.vdb", "soot", "temperature")
    with pytest.raises(InvalidScene, match=r"has the grids velocity, soot, temperature; allowed: `grid=NAME`"):
        convert_file(tmp_path / "smoke.vdb", tmp_path / "smoke.svo.npz")


@pytest.mark.parametrize("ending", ["nvdb", "vdb", "vdb.npz", "nvdb.zst"])
def test_each_grid_becomes_a_file_of_its_own(ending: str, tmp_path: Path) -> None:
    whole = smoke(tmp_path / "smoke.vdb", "density")
    made = split_volume(tmp_path / "smoke.vdb", tmp_path / f"out.{ending}")
    assert list(made) == [str(tmp_path / f"out.{name}.{ending}") for name in ("velocity", "density")]
    for path, grid in zip(made, whole.grids, strict=True):
        (back,) = load(path, Volume).grids
        assert isinstance(grid, VdbTree)
        assert isinstance(back, VdbTree)
        assert (back.name, back.values.tolist()) == (grid.name, grid.values.tolist())


def test_names_of_grids_cannot_lead_elsewhere(tmp_path: Path) -> None:
    smoke(tmp_path / "smoke.vdb", "../../up", "a b", "a_b", "", "x" * 200)
    made = split_volume(tmp_path / "smoke.vdb", tmp_path / "out.nvdb")
    names = ["velocity", "up", "a_b", "3.a_b", "0", "x" * 100]
    assert list(made) == [str(tmp_path / f"out.{name}.nvdb") for name in names]
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(
        ["smoke.vdb", *(Path(name).name for name in made)]
    )


def test_nothing_is_written_if_one_of_the_files_exists(tmp_path: Path) -> None:
    smoke(tmp_path / "smoke.vdb", "density")
    (tmp_path / "out.density.nvdb").write_text("mine")
    with pytest.raises(OutputError, match="exists already"):
        split_volume(tmp_path / "smoke.vdb", tmp_path / "out.nvdb")
    assert not (tmp_path / "out.velocity.nvdb").exists()
    assert (tmp_path / "out.density.nvdb").read_text() == "mine"


@pytest.mark.parametrize("target", ["-", "out.svo.npz"])
def test_grids_are_written_as_volumes_alone(target: str, tmp_path: Path) -> None:
    smoke(tmp_path / "smoke.vdb", "density")
    with pytest.raises(UsageError, match="cannot write one file per grid to"):
        split_volume(tmp_path / "smoke.vdb", target)
