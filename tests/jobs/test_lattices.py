"""Whatever takes a PlenOctree takes another program's lattice, and says what became of it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import (
    LatticeField,
    Meshes,
    SparseVoxelOctree,
    Volume,
    build_octree,
    build_octree_from_lattice,
    jobs,
    load,
    orbit_cameras,
    save,
)
from nerfbake.cli.main import run
from nerfbake.errors import BudgetMissed, InvalidFile, OutputError, UsageError
from nerfbake.jobs import Budget, ComparedViews, PictureOutputs, PlacedMesh, ViewSelection, readings
from tests.jobs.listener import Listener
from tests.support.lattices import SHAPE, svox2, svox2_file
from tests.support.meshes import cube
from tests.support.scenes import assert_same_octree, n3tree

LAYERS = {"background_links": np.zeros((8, 4), np.int32), "background_data": np.zeros((3, 2, 4), np.float32)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("lattices")
    (folder / "ckpt.npz").write_bytes(svox2_file(svox2(size=4, plain=False) | LAYERS))
    save(folder / "cube.glb", Meshes((cube(0.1),)))
    save(folder / "c.json", orbit_cameras(load(folder / "ckpt.npz", LatticeField), frames=2, width=24, height=24))
    return folder


@pytest.fixture(autouse=True)
def _there(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    monkeypatch.setattr(readings, "_EDGE", 24)  # pixels: what is said is looked at, not what it is worth


def test_svo_says_what_it_cost() -> None:
    steps = Listener()
    octree = jobs.bake_octree("ckpt.npz", "a.svo.npz", options=jobs.ReadingOptions(basis="SH4"), steps=steps)
    assert_same_octree(load("a.svo.npz", SparseVoxelOctree), octree)
    assert_same_octree(octree, build_octree_from_lattice(load("ckpt.npz", LatticeField), basis="SH4"))
    note, cost, _ = steps.said
    assert note.startswith("ckpt.npz: the background")
    assert cost.startswith("ckpt.npz: in 10x12x14 voxels, ")
    assert "dB against pictures of the lattice; colours differ by" in cost


def test_the_command_takes_a_basis_a_scale_and_a_budget() -> None:
    line = ["svo", "ckpt.npz", "b.svo.npz", "--basis", "SH1", "--scale", "1.5", "--resolution", "6x6x6", "-q"]
    assert run([*line, "--min-psnr", "5", "--cameras", "c.json"]) == 0
    octree = load("b.svo.npz", SparseVoxelOctree)
    lattice = load("ckpt.npz", LatticeField)
    assert_same_octree(octree, build_octree_from_lattice(lattice.scaled(1.5), basis="SH1", resolution=(6, 6, 6)))
    with pytest.raises(BudgetMissed, match="dB"):
        jobs.bake_octree(
            "ckpt.npz",
            "c.svo.npz",
            options=jobs.ReadingOptions(basis="SH1"),
            resolution=(3, 3, 3),
            budget=Budget(min_psnr=90, cameras="c.json"),
        )


def test_others_take_it_too() -> None:
    octree = build_octree_from_lattice(load("ckpt.npz", LatticeField))
    assert_same_octree(load_octree("d.svo.pb"), octree.with_layout("compact"))
    volume = jobs.bake_volume("ckpt.npz", "a.vdb", resolution=8)
    assert isinstance(volume, Volume)
    assert volume.frame is not None
    assert volume.frame.size == (8, 8, 8)
    found = jobs.compare_files("ckpt.npz", "d.svo.pb", seen=ComparedViews(size=(16, 16))).found
    assert found.means["a_b"]["psnr"] > 15
    assert jobs.describe_file("ckpt.npz")["resolution"] == list(SHAPE)
    assert run(["check", "ckpt.npz"]) == 0


def load_octree(name: str) -> SparseVoxelOctree:
    jobs.convert_file("ckpt.npz", name, layout="compact")
    return load(name, SparseVoxelOctree)


def test_pictures_are_the_lattices_own_and_with_a_mesh_the_octrees() -> None:
    shots = ViewSelection(size=(16, 16))
    jobs.render_views("ckpt.npz", PictureOutputs(out="a.png"), shots, lookup="trilinear")
    steps = Listener()
    jobs.render_views("ckpt.npz", PictureOutputs(out="b.png"), shots, mesh=PlacedMesh(path="cube.glb"), steps=steps)
    assert any("voxels" in line for line in steps.said)
    assert Path("a.png").read_bytes() != Path("b.png").read_bytes()


def test_a_page_of_it_is_a_page_of_its_octree() -> None:
    assert jobs.view_file("ckpt.npz", "a.html", data="exact").title == "ckpt"


def test_an_octree_becomes_a_folder_whose_loss_is_told(tmp_path: Path) -> None:
    jobs.write_sample_n3tree(tmp_path / "tree.npz", resolution=16)
    steps = Listener()
    told = jobs.bake_lattice(tmp_path / "tree.npz", tmp_path / "out", resolution=8, rounds=20, steps=steps)
    (line,) = steps.said
    assert line.startswith(f"{tmp_path / 'out'}: lattice field of 10x10x8, ")
    assert " dB against pictures of the octree; colours differ by " in line
    found = load(tmp_path / "out", LatticeField)
    assert_array_equal(found.box, told.box)
    assert_array_equal(found.density.reshape(told.shape)[told.links >= 0], told.density[told.links[told.links >= 0]])
    jobs.bake_octree(tmp_path / "out", tmp_path / "back.svo.npz", options=jobs.ReadingOptions(basis="SH1"))
    with pytest.raises(OutputError, match="exists already"):
        jobs.bake_lattice(tmp_path / "tree.npz", tmp_path / "out", rounds=1)


def test_a_merged_folder_that_loses_too_much_is_set_aside(tmp_path: Path) -> None:
    save("f.npz", n3tree(data_format="SH1"))
    line = ["lattice", "f.npz", str(tmp_path / "out"), "--rounds", "1", "--merged", "-q"]
    assert run([*line, "--min-psnr", "90", "--cameras", "c.json"]) == 3
    (rejected,) = tmp_path.iterdir()
    assert rejected.name == "out.rejected"
    assert load(rejected, LatticeField).dialect == "PlenVDB, merged"


def test_an_octree_keeps_its_own_voxels(tmp_path: Path) -> None:
    save("f.svo.pb", build_octree(n3tree(data_format="SH1")))
    with pytest.raises(UsageError, match="`resolution` has no effect on an octree; allowed: with a PlenOctree, a l"):
        jobs.bake_lattice("f.svo.pb", tmp_path / "out", resolution=8)


def test_what_only_one_of_the_two_takes_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="`resample` has no effect on a lattice"):
        jobs.bake_octree("ckpt.npz", "e.svo.npz", resample="nearest")
    jobs.write_sample_n3tree(tmp_path / "tree.npz", resolution=8)
    with pytest.raises(UsageError, match="`basis` has no effect on a PlenOctree; allowed: with a lattice, splats"):
        jobs.bake_octree(tmp_path / "tree.npz", "e.svo.npz", options=jobs.ReadingOptions(basis="SH4"))
    with pytest.raises(InvalidFile, match=r"holds a lattice field \(`nerfbake svo` makes an octree of it\)"):
        jobs.bake_lod("ckpt.npz", "e.svo.npz", level=1)
