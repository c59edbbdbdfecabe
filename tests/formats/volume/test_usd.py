"""Stages of volumes: OpenUSD finds the .vdb beside them, and nothing else is needed to write them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from pxr import Usd, UsdGeom, UsdVol

from nerfbake import build_octree, build_vdb, load, save
from nerfbake.errors import InvalidFile, InvalidScene, UsageError
from nerfbake.formats.volume import usda, usdc
from nerfbake.jobs import bake_volume
from nerfbake.jobs.budgets import Budget
from nerfbake.scene.volume import Volume
from tests.support.scenes import n3tree
from tests.support.usd import errors_of, facts_of
from tests.support.usd import in_this_process as in_this_process


@pytest.fixture(scope="module")
def volume() -> Volume:
    return build_vdb(build_octree(n3tree(data_format="SH4")), grids=("density", "Cd"))


@pytest.mark.parametrize("ending", ["usda", "usdc"])
@pytest.mark.parametrize("up", ["y", "z"])
def test_openusd_finds_each_grid(volume: Volume, ending: str, up: str, tmp_path: Path) -> None:
    save(tmp_path / f"a b.{ending}", volume, up=up, codec="none")
    assert {path.name for path in tmp_path.iterdir()} == {f"a b.{ending}", "a b.vdb"}
    stage = Usd.Stage.Open(str(tmp_path / f"a b.{ending}"))
    assert facts_of(stage) == (up.upper(), 1.0, "/scene")
    assert errors_of(stage) == []
    prim = UsdVol.Volume(stage.GetPrimAtPath("/scene/volume"))
    paths = prim.GetFieldPaths()
    assert {*paths} == {"density", "Cd"}
    for name, path in paths.items():
        field = UsdVol.OpenVDBAsset(stage.GetPrimAtPath(path))
        assert field.GetFieldNameAttr().Get() == name
        assert Path(field.GetFilePathAttr().Get().resolvedPath) == tmp_path / "a b.vdb"
    (tmp_path / "a b.vdb").unlink()
    assert any("UnresolvableDependency" in each for each in errors_of(Usd.Stage.Open(str(tmp_path / f"a b.{ending}"))))


def test_the_extent_is_the_box_of_the_voxels(volume: Volume, tmp_path: Path) -> None:
    save(tmp_path / "a.usda", volume)
    stage = Usd.Stage.Open(str(tmp_path / "a.usda"))
    extent = np.asarray(UsdGeom.Boundable(stage.GetPrimAtPath("/scene/volume")).GetExtentAttr().Get())
    grid = volume.grids[0]
    centres = grid.topology.coords @ volume.transform[:, :3].T + volume.transform[:, 3]
    half = volume.voxel_size / 2
    assert np.allclose(extent, [centres.min(axis=0) - half, centres.max(axis=0) + half], atol=1e-6)


def test_the_vdb_is_the_one_that_is_written_alone(volume: Volume, tmp_path: Path) -> None:
    save(tmp_path / "a.usdc", volume)
    save(tmp_path / "b.vdb", volume)
    assert (tmp_path / "a.vdb").read_bytes() == (tmp_path / "b.vdb").read_bytes()


@pytest.mark.slow
@pytest.mark.usefixtures("fewer_rays")
def test_a_scene_becomes_a_stage_with_a_budget(tmp_path: Path) -> None:
    save(tmp_path / "a.npz", n3tree(data_format="SH4"))
    bake_volume(tmp_path / "a.npz", tmp_path / "a.usda", up="y", resolution=4, budget=Budget(min_psnr=1))
    assert load(tmp_path / "a.vdb", Volume).labels == ["density", "Cd"]
    with pytest.raises(UsageError, match=r"a .usdz cannot contain a .vdb; allowed: .usda or .usdc"):
        bake_volume(tmp_path / "a.npz", tmp_path / "a.usdz")
    (tmp_path / "b.vdb").write_bytes(b"mine")
    with pytest.raises(Exception, match=r"b\.vdb: exists already"):
        bake_volume(tmp_path / "a.npz", tmp_path / "b.usda")
    assert (tmp_path / "b.vdb").read_bytes() == b"mine"


@pytest.mark.usefixtures("in_this_process")
def test_a_stage_is_not_read_but_names_the_file_that_is(volume: Volume, tmp_path: Path) -> None:
    for ending in ("usda", "usdc"):
        save(tmp_path / f"a.{ending}", volume, force=True)
        for kinds in ((), (Volume,)):
            with pytest.raises(InvalidFile, match=r"the stage is that of a volume; allowed: the \.vdb beside it|holds"):
                load(tmp_path / f"a.{ending}", *kinds)


def test_what_a_stage_cannot_hold_is_refused(volume: Volume) -> None:
    for module in (usda, usdc):
        with pytest.raises(InvalidScene, match=r"needs a \.vdb beside the stage"):
            module.encode(volume)
    twice = Volume((volume.grids[0], volume.grids[0]), volume.transform)
    with pytest.raises(InvalidScene, match="each name once"):
        list(usda.encode_files(twice, "a"))
