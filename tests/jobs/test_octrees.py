"""Octrees from files to files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from nerfbake import (
    Camera,
    N3Tree,
    SparseVoxelOctree,
    build_field,
    build_n3tree,
    build_octree,
    cut_octree,
    load,
    render_field,
    save,
)
from nerfbake.errors import BudgetMissed, OutputError, UsageError
from nerfbake.jobs import Budget, ReadingOptions, Target, bake_lod, bake_octree, readings
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.camera import look_at
from tests.jobs.listener import Listener
from tests.support.brick_fields import some_shelled_field
from tests.support.lattices import svox2_file
from tests.support.scenes import assert_same_octree
from tests.support.svraster import svraster_file


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
        bake_octree("a.npz", "b.svo.pb", resolution=1, budget=Budget(min_psnr=50, cameras="cameras.json"))
    assert missed.value.exit_code == 3
    assert not (folder / "b.svo.pb").exists()
    assert load("b.svo.pb.rejected", SparseVoxelOctree).size == (1, 1, 1)
    with pytest.raises(BudgetMissed):
        bake_lod("a.svo.pb", "c.svo.pb", level=0, budget=Budget(min_psnr=50, cameras="cameras.json"))
    assert not (folder / "c.svo.pb").exists()


@pytest.fixture
def scenery(folder: Path) -> N3Tree:
    """s.npz: an inner cube of 64^3 over [-1, 1]^3 with two shells around it."""
    tree = build_n3tree(some_shelled_field(basis=4))
    save(folder / "s.npz", tree)
    return tree


def test_the_box_of_scenery_is_the_inner_cube_or_everything(scenery: N3Tree, listener: Listener) -> None:
    inner = bake_octree("s.npz", "inner.svo.npz", steps=listener)
    whole = bake_octree("s.npz", "all.svo.npz", options=ReadingOptions(box="all"), steps=listener)
    assert listener.said[::2] == [
        "s.npz: uses the inner cube of 64^3 and leaves out the scenery around it",
        "s.npz: uses all of the scene: 256x256x256 voxels, 64x64x64 of them in the inner cube of 64^3",
    ]
    assert (inner.size, whole.size) == ((64,) * 3, (256,) * 3)
    points = np.random.default_rng(0).uniform(-4, 4, (4000, 3))
    points[:2000] /= 4  # in the inner cube
    np.testing.assert_array_equal(whole.sample(points), scenery.sample(points))
    np.testing.assert_array_equal(inner.sample(points[:2000]), scenery.sample(points[:2000]))
    assert inner.sample(points[2000:])[np.abs(points[2000:]).max(axis=1) > 1].max() == 0
    view = Camera(40, 30, 20.0, look_at(np.zeros(3), 0.3, 0.2, 1.5))
    own, made = (render_field(build_field(scene), view).colour.astype(np.float64) for scene in (scenery, whole))
    assert psnr(made, own) > 60


def test_a_whole_scene_is_coarser_where_an_octree_would_be_too_large(
    scenery: N3Tree, listener: Listener, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(readings, "MAX_SIZE", 128)
    octree = bake_octree("s.npz", "all.svo.npz", options=ReadingOptions(box="all"), steps=listener)
    assert_same_octree(octree, build_octree(scenery, resolution=128))
    said = "s.npz: uses all of the scene: 128x128x128 voxels, 32x32x32 of them in the inner cube of 64^3"
    assert listener.said[0] == said
    bake_octree("s.npz", "thin.svo.npz", resolution=(256, 64, 6), options=ReadingOptions(box="all"), steps=listener)
    assert "256x64x6 voxels, 64x16x1.5 of them in the inner cube" in listener.said[2]


@pytest.mark.usefixtures("folder")
def test_a_scene_without_scenery_has_one_box(listener: Listener) -> None:
    bake_octree("a.npz", "inner.svo.pb", options=ReadingOptions(box="inner"), steps=listener)
    bake_octree("a.npz", "all.svo.pb", options=ReadingOptions(box="all"), steps=listener)
    assert Path("inner.svo.pb").read_bytes() == Path("all.svo.pb").read_bytes()
    assert len(listener.said) == 2  # the files
    Path("ckpt.npz").write_bytes(svox2_file())
    with pytest.raises(UsageError, match="`box` has no effect on a lattice"):
        bake_octree("ckpt.npz", "c.svo.pb", options=ReadingOptions(box="all"))


def test_what_a_reader_resamples_is_told(tmp_path: Path, listener: Listener) -> None:
    (tmp_path / "a.pt").write_bytes(svraster_file())
    bake_octree(tmp_path / "a.pt", tmp_path / "a.svo.npz", steps=listener)
    assert any("the density of a voxel is the mean of 8 points" in line for line in listener.said)
