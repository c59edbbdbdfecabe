"""A trained field becomes voxels in every job by the same rules."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Cameras, Image, N3Tree, SparseVoxelOctree, jobs, load, save
from nerfbake.errors import BudgetMissed, NerfbakeError, UsageError
from nerfbake.jobs.function_voxels import FunctionVoxels, bake_field
from nerfbake.jobs.reading_options import ReadingOptions
from nerfbake.stages.function_to_part import cameras_of
from tests.jobs.listener import Listener
from tests.support.functions import TURN, soft_field, soft_file
from tests.support.scenes import n3tree

SOURCE = jobs.Source("soft.tar")
SMALL = FunctionVoxels(resolution=16, basis="SH1")


@pytest.fixture(autouse=True)
def fast(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "soft.tar").write_bytes(soft_file())
    for name, value in {
        "nerfbake.jobs.function_voxels._EDGE": 8,
        "nerfbake.scene.function_field._COARSE_GRID": 16,
        "nerfbake.stages.function_to_part._RESOLUTION": 16,
        "nerfbake.stages.function_to_image.STEPS": 64,
    }.items():
        monkeypatch.setattr(name, value)


def test_the_loss_and_the_light_outside_are_said(listener: Listener) -> None:
    tree, _ = bake_field(listener, SOURCE, soft_field(), SMALL)
    assert listener.said[0] == (
        "soft.tar: has no cameras, and is baked as seen from all around; `seen_from` gives cameras"
    )
    assert listener.said[1].startswith("soft.tar: bakes the box from -0.")
    assert listener.said[1].endswith(": 0.0% of the light comes from outside of the middle")
    assert listener.said[2].startswith(f"soft.tar: {tree}, ")
    assert listener.said[2].endswith("against 4 pictures of the field itself; 0.00% of their light is from outside of "
                                     "what was baked")  # fmt: skip
    shares = [share for share, _ in listener.shares]
    assert max(shares) == 1


def test_a_box_cuts_and_the_light_outside_is_counted(listener: Listener) -> None:
    corners = (-1.0, -1.0, -1.0, 1.0, 1.0, 0.0)
    tree, _ = bake_field(listener, SOURCE, soft_field(), replace(SMALL, box=corners))
    assert_allclose(-tree.offset / tree.invradius, [-1, -1, -1])
    assert_allclose(1 / tree.invradius, [2, 2, 1])
    assert "; 0.00%" not in listener.said[-1]
    whole, _ = bake_field(listener, SOURCE, soft_field(), replace(SMALL, box="all"))
    assert_allclose(1 / whole.invradius, [2, 2, 2])


def test_the_world_is_that_of_the_cameras_or_of_the_network(listener: Listener) -> None:
    field = soft_field(frame=TURN)
    tree, _ = bake_field(listener, SOURCE, SMALL.placed(field), SMALL)
    trained = replace(SMALL, world="trained")
    other, _ = bake_field(listener, SOURCE, trained.placed(field), trained)
    middle = TURN[:, :3].T @ -TURN[:, 3] / 4
    assert_allclose((0.5 - tree.offset) / tree.invradius, middle, atol=0.05)
    assert_allclose((0.5 - other.offset) / other.invradius, 0, atol=0.1)
    assert_allclose(1 / other.invradius, 2 / tree.invradius, rtol=0.1)


def test_the_colour_of_the_last_sample_is_left_out_without_scenery(listener: Listener) -> None:
    field = soft_field(background="last", contracted=True, far=50.0, cameras=cameras_of(soft_field()))
    _, shown = bake_field(listener, SOURCE, field, replace(SMALL, box="all"))
    assert shown.background is None
    assert any("leaves out the colour of the last sample" in line for line in listener.said)


def test_many_cameras_hold_back_those_of_the_pictures(monkeypatch: pytest.MonkeyPatch, listener: Listener) -> None:
    cameras, seen = cameras_of(soft_field()), []
    from nerfbake.stages import function_to_brick_field

    bake = function_to_brick_field.bake_function

    def spy(field: Any, **options: Any) -> Any:
        seen.append(set(options["cameras"].names))
        return bake(field, **options)

    monkeypatch.setattr(function_to_brick_field, "bake_function", spy)
    bake_field(listener, SOURCE, soft_field(cameras=cameras), SMALL)
    assert seen == [set(cameras.names) - set(cameras.few(4, 8).names)]


def test_options_of_all_scenes_come_first() -> None:
    voxels = FunctionVoxels(resolution=64, basis="SH4", box=(0.0, 0.0, 0.0, 1.0, 1.0, 1.0))
    assert voxels.with_others(ReadingOptions()) == voxels
    assert voxels.with_others(ReadingOptions(box="all", basis="SH9"), 32) == FunctionVoxels(
        resolution=32, basis="SH9", box="all"
    )
    with pytest.raises(UsageError, match="a trained field has as many cells along each axis; allowed: one number"):
        voxels.with_others(ReadingOptions(), (8, 16, 8))


def test_convert_writes_a_plenoctree_or_an_octree(listener: Listener) -> None:
    jobs.convert_file("soft.tar", "soft.npz", functions=SMALL, budget=jobs.Budget(min_psnr=30), steps=listener)
    tree = load("soft.npz", N3Tree)
    assert (tree.resolution, tree.data_format) == (16, "SH1")
    assert sum("dB against soft.tar" in line for line in listener.said) == 1
    jobs.convert_file("soft.tar", "soft.svo.npz", functions=SMALL)
    assert load("soft.svo.npz", SparseVoxelOctree).size == (16, 16, 16)
    with pytest.raises(BudgetMissed):
        jobs.convert_file("soft.tar", "bad.npz", functions=SMALL, budget=jobs.Budget(min_psnr=90))
    assert Path("bad.npz.rejected").exists()
    save("tree.svo.npz", load("soft.svo.npz"))
    with pytest.raises(NerfbakeError):
        jobs.convert_file("tree.svo.npz", "tree.npz")
    with pytest.raises(UsageError, match="a PlenOctree has no child slots"):
        jobs.convert_file("soft.tar", "other.npz", layout="full")


def test_cameras_that_it_is_baked_for_come_from_a_capture(listener: Listener) -> None:
    cameras = cameras_of(soft_field())
    above = [camera for camera in cameras.cameras if camera.pose[2, 3] > 1]
    save("above.json", Cameras(tuple(above)))
    tree, shown = bake_field(listener, SOURCE, soft_field(), replace(SMALL, seen_from="above.json"))
    assert shown.cameras is not None
    assert len(shown.cameras.cameras) == len(above)
    assert not any("has no cameras" in line for line in listener.said)
    assert tree.resolution == 16


def test_render_and_compare_take_the_field_itself(listener: Listener) -> None:
    shots = jobs.ViewSelection(size=(9, 9))
    jobs.render_views("soft.tar", "own.png", shots)  # white, as nerf-pytorch trains
    jobs.render_views("soft.tar", "black.png", shots, background=(0.0, 0.0, 0.0))
    own, black = load("own.png", Image), load("black.png", Image)
    assert_allclose(own.colour[0, 0], 1)
    assert_allclose(black.colour[0, 0], 0)
    assert_allclose(own.colour[4, 4], black.colour[4, 4], atol=0.02)
    jobs.convert_file("soft.tar", "soft.npz", functions=SMALL)
    seen = jobs.ComparedViews(size=(16, 16))
    found = jobs.compare_files("soft.tar", "soft.npz", seen=seen, steps=listener)
    assert found.found.means["a_b"]["psnr"] > 30
    with pytest.raises(UsageError, match="`world` has no effect on a PlenOctree"):
        jobs.render_views("soft.npz", "x.png", replace(shots, world="trained"))
    with pytest.raises(UsageError, match="`world` has no effect on these scenes; allowed: with a trained field"):
        jobs.compare_files("soft.npz", "soft.npz", seen=replace(seen, world="trained"))


def test_info_tells_the_network_and_the_box() -> None:
    facts = jobs.describe_file("soft.tar")
    assert facts["kind"] == "trained field"
    assert facts["dialect"] == "nerf-pytorch"
    assert facts["world_box"] == [[-1.5] * 3, [1.5] * 3]
    assert (facts["contracted"], facts["cameras"], facts["background"]) == (False, None, None)


def test_the_lattice_of_another_scene_may_have_a_resolution_along_each_axis() -> None:
    save("tree.npz", n3tree([(0, (1, 0, 1))], invradius=np.array([1, 0.5, 0.5])))
    assert jobs.bake_lattice("tree.npz", "lattice", resolution=(2, 4, 4), rounds=1).cells == (3, 5, 5)
    with pytest.raises(UsageError, match="a trained field has as many cells along each axis"):
        jobs.bake_lattice("soft.tar", "soft_lattice", resolution=(8, 16, 8), rounds=1)
