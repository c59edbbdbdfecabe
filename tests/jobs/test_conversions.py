"""The same octree or the same volume in another file."""

from __future__ import annotations

import gzip
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import SparseVoxelOctree, Splats, VdbTree, Volume, load, save
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError, OutputError, UsageError
from nerfbake.jobs import (
    GridChoice,
    SplatChoice,
    Target,
    bake_volume,
    convert_file,
    convert_splats,
    describe_file,
    split_volume,
)
from tests.jobs.listener import Listener
from tests.support.scenes import assert_same_octree
from tests.support.splats import gzip_spz, splats, with_property
from tests.support.standing import standing
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
    volume = convert_file(
        "a.vdb", Target("b", to="nvdb"), choice=GridChoice(grids=("density",)), half=True, steps=listener
    )
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
        convert_file("a.vdb", "b.svo.npz", choice=GridChoice(grids=("heat",)))
    assert not list(folder.glob("b*"))


def test_an_octree_is_made_of_the_density_wherever_it_stands(tmp_path: Path, listener: Listener) -> None:
    path = tmp_path / "smoke.vdb"
    smoke(path, "density", "temperature")
    octree = convert_file(path, tmp_path / "all.svo.npz", steps=listener)
    alone = convert_file(path, tmp_path / "alone.svo.npz", choice=GridChoice(grids=("density",)))
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


# -- splats -----------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("ending", ["ply", "glb"])
def test_splats_in_another_format_without_loss(ending: str, tmp_path: Path, listener: Listener) -> None:
    scene = splats(30, degree=2)
    save(tmp_path / "a.ply", scene)
    found = convert_file(tmp_path / "a.ply", tmp_path / f"b.{ending}", steps=listener)
    assert isinstance(found, Splats)
    assert np.array_equal(load(tmp_path / f"b.{ending}", Splats).means, scene.means)
    assert listener.said[-1] == f"{tmp_path / f'b.{ending}'}: nothing is lost but the rounding of float32"


def test_what_a_format_loses_is_told(tmp_path: Path, listener: Listener) -> None:
    save(tmp_path / "a.spz", splats(30, degree=4))
    convert_file(tmp_path / "a.spz", tmp_path / "b.spz", splats=SplatChoice(small=True), steps=listener)
    assert "centres 0 (0) world units, scales 0 (0) %" in listener.said[-2]
    convert_file(tmp_path / "a.spz", tmp_path / "b.ply", steps=listener)
    assert listener.said[-1].endswith("; SH bands left out: 1")
    assert load(tmp_path / "b.ply", Splats).degree == 3


@pytest.mark.parametrize("error", [MemoryLimit, KeyboardInterrupt])
def test_a_file_whose_loss_cannot_be_measured_gets_no_name(
    error: type[BaseException], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*splats: object) -> None:
        raise error("the loss", 2, 1)

    save(tmp_path / "a.ply", splats(30, degree=2))
    monkeypatch.setattr("nerfbake.stages.splats_to_loss.measure_splats", fail)
    (tmp_path / "b.spz").write_bytes(b"good")
    for name in ("a.spz", "b.spz"):
        with pytest.raises(error) as caught:
            convert_splats(tmp_path / "a.ply", Target(str(tmp_path / name), force=True))
        assert error is KeyboardInterrupt or str(caught.value).startswith(f"{tmp_path / name}: the loss")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.ply", "b.spz"]
    assert (tmp_path / "b.spz").read_bytes() == b"good"


def test_the_axis_that_points_up_becomes_that_of_the_format(tmp_path: Path) -> None:
    scene = splats(30)
    save(tmp_path / "z_up.ply", scene)
    convert_splats(tmp_path / "z_up.ply", tmp_path / "b.glb", in_up="z")
    raw = load(tmp_path / "b.glb", Splats).flipped()  # in the axes of glTF
    np.testing.assert_allclose(raw.means, scene.means[:, [0, 2, 1]] * [1, 1, -1], atol=1e-6)


def test_the_axes_of_a_spz_are_chosen_and_its_old_readers_named(tmp_path: Path, listener: Listener) -> None:
    scene = splats(30, degree=1)
    (tmp_path / "a.spz").write_bytes(gzip_spz(scene, 3))  # as a program writes it that turns nothing
    convert_splats(tmp_path / "a.spz", tmp_path / "b.spz", choice=SplatChoice(in_axes="RDF"), steps=listener)
    assert f"{tmp_path / 'a.spz'}: axes not named; read as right, up, back (SPZ's README)" in listener.said
    assert listener.said[-1].startswith(f"{tmp_path / 'b.spz'}: version 4 of .spz; Spark 2.2, Omniverse's converter, ")
    assert not any("upside down" in line for line in listener.said)
    np.testing.assert_allclose(load(tmp_path / "b.spz", Splats).means, scene.means, atol=1e-3)
    choice = SplatChoice(axes="LFU", spz_version=3)
    convert_splats(tmp_path / "b.spz", tmp_path / "c.spz", choice=choice, steps=listener)
    assert "largest (median) loss" in listener.said[-2]
    assert "names its axes in version 3 of .spz; three.js 0.187 refuses that" in listener.said[-1]
    convert_splats(tmp_path / "b.spz", tmp_path / "d.spz", choice=SplatChoice(spz_version=3), steps=listener)
    assert listener.said[-1].endswith("d.spz: nothing is lost but the rounding of float32")
    found = load(tmp_path / "c.spz", Splats)
    assert found.axes == "LFU"
    np.testing.assert_allclose(found.means, scene.means, atol=1e-3)


def test_splats_that_look_upside_down_are_told_unless_their_axes_are_known(tmp_path: Path, listener: Listener) -> None:
    scene = standing("a turntable")
    (tmp_path / "a.spz").write_bytes(gzip_spz(scene, 3))  # turns nothing
    note = "this file looks upside down (its upper end has "
    advice = "; try `in_axes=RDF` of `nerfbake convert`"
    convert_splats(tmp_path / "a.spz", tmp_path / "b.spz", steps=listener)
    (line,) = (line for line in listener.said if note in line)
    assert line.startswith(str(tmp_path / "a.spz"))
    assert line.endswith(advice)
    (told,) = (line for line in describe_file(tmp_path / "a.spz")["notes"] if line.startswith(note))
    assert told.endswith(advice)
    assert describe_file(tmp_path / "b.spz")["notes"] is None  # names its axes
    convert_splats(tmp_path / "a.spz", tmp_path / "c.glb", choice=SplatChoice(in_axes="RDF"), steps=listener)
    assert sum(note in line for line in listener.said) == 1
    (tmp_path / "d.spz").write_bytes(gzip_spz(scene.flipped(), 3))  # as SPZ's README says
    assert not any("upside" in line for line in describe_file(tmp_path / "d.spz")["notes"])
    whole = (tmp_path / "c.glb").read_bytes()
    for generator, known in ((b"nerfbake", True), (b"somebody", False)):
        (tmp_path / "e.glb").write_bytes(whole.replace(b"nerfbake", generator, 1))
        assert load(tmp_path / "e.glb", Splats).axes_known == known


def test_notes_and_dropped_rows_of_splats_are_told(tmp_path: Path, listener: Listener) -> None:
    whole = bytearray(gzip.decompress(gzip_spz(splats(9), 1)) + struct.pack("<II", 0xADBE0002, 0))
    whole[14], whole[16:18] = 2, b"\xff\xff"
    (tmp_path / "a.spz").write_bytes(gzip.compress(whole))
    convert_file(tmp_path / "a.spz", tmp_path / "b.ply", steps=listener)
    name = str(tmp_path / "a.spz")
    assert f"{name}: extension 0xADBE0002 is left out" in listener.said
    assert f"{name}: had 1 row that cannot be drawn, which were left out" in listener.said


def test_options_that_do_not_fit_splats_are_told(tmp_path: Path) -> None:
    save(tmp_path / "a.ply", splats(3))
    for options, said in (
        ({"half": True}, r"glb takes no option 'half'; allowed: none"),
        ({"choice": GridChoice(grids=("density",))}, "splats have no child slots, grids and codecs"),
        ({"choice": GridChoice(in_up="w")}, "`in_up` is 'w'; allowed: x, -x, y, -y, z, -z"),
        ({"splats": SplatChoice(small=True)}, r"glb takes no option 'small'; allowed: none"),
        ({"splats": SplatChoice(spz_version=3)}, r"glb takes no option 'spz_version'; allowed: none"),
        ({"splats": SplatChoice(in_axes="RDF")}, r"`in_axes` has no effect on .*a\.ply, whose numbers are its world"),
    ):
        with pytest.raises(UsageError, match=said):
            convert_file(tmp_path / "a.ply", tmp_path / "b.glb", **options)
    with pytest.raises(UsageError, match="`small` is for splats"):
        convert_file(tmp_path / "a.svo.pb", tmp_path / "b.svo.npz", splats=SplatChoice(small=True))
    with pytest.raises(UsageError, match="`spz_version` is for splats; allowed: OUT of splats"):
        convert_file(tmp_path / "a.svo.pb", tmp_path / "b.svo.npz", splats=SplatChoice(spz_version=3))
    with pytest.raises(UsageError, match=r"no file extension for Gaussian splats; allowed: \.glb, \.ply, \.usda, "):
        convert_file(tmp_path / "a.ply", tmp_path / "b.splat")
    assert not list(tmp_path.glob("b*"))


UTM = np.array([453000.125, 5012345.625, 120.25])


def test_splats_on_a_map_keep_their_origin_or_are_told_to_lose_it(tmp_path: Path, listener: Listener) -> None:
    scene = replace(splats(30), origin=UTM)
    save(tmp_path / "a.ply", scene)
    for ending in ("ply", "glb"):
        convert_file(tmp_path / "a.ply", tmp_path / f"b.{ending}", steps=listener)
        assert listener.said[-1].endswith(": nothing is lost but the rounding of float32")
        found = load(tmp_path / f"b.{ending}", Splats)
        np.testing.assert_allclose(found.means + found.origin, scene.means + UTM, rtol=0, atol=1e-6)
    assert not any("origin" in line for line in listener.said)
    convert_splats(tmp_path / "a.ply", tmp_path / "b.spz", in_up="z", steps=listener)
    kept = load(tmp_path / "a.ply", Splats).with_up("z").origin
    told = "positions are relative to the origin {:.15g} {:.15g} {:.15g}, which .spz cannot keep".format(*kept)
    assert f"{tmp_path / 'b.spz'}: {told}" in listener.said
    assert "world units, scales" in listener.said[-2]
    near = load(tmp_path / "b.spz", Splats)
    places = (scene.means + UTM)[:, [0, 2, 1]] * [1, -1, 1]
    np.testing.assert_allclose(near.means, places - kept, atol=1e-5)
    assert "centres 1" not in listener.said[-2]  # the shift itself is no loss


def test_what_was_not_read_is_in_the_last_line(tmp_path: Path, listener: Listener) -> None:
    save(tmp_path / "a.ply", splats(30))
    content = with_property((tmp_path / "a.ply").read_bytes(), "float trbf_center")
    (tmp_path / "a.ply").write_bytes(content)
    convert_file(tmp_path / "a.ply", tmp_path / "b.glb", steps=listener)
    assert listener.said[0].endswith("is left out: the splats of all times are shown together")
    assert listener.said[-1].endswith("of float32; not read: movement (trbf_*, motion_*, omega_*)")


def test_a_stated_axis_is_kept_and_told(tmp_path: Path, listener: Listener) -> None:
    save(tmp_path / "a.ply", replace(splats(3), up="z"))
    convert_file(tmp_path / "a.ply", tmp_path / "b.glb", steps=listener)
    name = str(tmp_path / "a.ply")
    assert listener.said[0] == f"{name}: z points up, as the file says; only `in_up=z` turns the splats"
    convert_splats(tmp_path / "a.ply", tmp_path / "c.ply", in_up="z", steps=listener)
    assert not any("as the file says" in line for line in listener.said[1:])
    assert load(tmp_path / "c.ply", Splats).up is None  # -y, as is usual
