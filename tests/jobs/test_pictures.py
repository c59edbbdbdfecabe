"""Pictures of a file: names, places, and what stands beside them."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from nerfbake import (
    Cameras,
    Depth,
    Image,
    Meshes,
    N3Tree,
    Stage1,
    build_field,
    build_octree,
    build_vdb,
    cut_octree,
    load,
    orbit_cameras,
    render_field,
    render_meshes,
    render_stage1,
    sample_stage1,
    save,
)
from nerfbake.errors import InvalidScene, NerfbakeError, OutputError, UsageError
from nerfbake.io import save_folder
from nerfbake.jobs import GridChoice, PictureOutputs, PlacedMesh, ViewSelection, render_views
from tests.jobs.listener import Listener
from tests.support.meshes import cube
from tests.support.splats import splats

ALL = ViewSelection(cameras="cameras.json", every=True)


def test_every_view_is_a_file_of_its_name(folder: Path, listener: Listener) -> None:
    wanted = PictureOutputs(out="views", depth="npy", alpha=True)
    paths = render_views("a.npz", wanted, ALL, steps=listener)
    assert paths == [f"views/000{i}.png" for i in range(3)]
    beside = [f"000{i}{ending}" for i in range(3) for ending in (".alpha.png", ".depth.npy", ".png")]
    assert sorted(path.name for path in (folder / "views").iterdir()) == beside
    assert load("views/0001.depth.npy", Depth).distance.shape == (16, 20)
    before = ["reading a.npz", "building the field", "reading cameras.json"]
    assert listener.phases == before + [f"rendering 000{i}" for i in range(3)]
    assert [line.split(":")[0] for line in listener.said] == paths


@pytest.mark.usefixtures("folder")
def test_one_of_the_cameras_is_what_the_stage_renders() -> None:
    assert render_views("a.npz", "b.png", ViewSelection(cameras="cameras.json", frame=2), transmittance_cut=0.5) == [
        "b.png"
    ]
    camera = load("cameras.json", Cameras).cameras[2]
    save("c.png", render_field(build_field(load("a.npz", N3Tree)), camera, transmittance_cut=0.5))
    assert Path("b.png").read_bytes() == Path("c.png").read_bytes()
    with pytest.raises(UsageError, match="`frame` is 3; allowed: 0 to 2"):
        render_views("a.npz", "d.png", ViewSelection(cameras="cameras.json", frame=3))


@pytest.mark.usefixtures("folder")
def test_several_in_one_file_hold_the_same_pictures() -> None:
    turn = ViewSelection(turntable=3, size=(8, 6))
    for out in ("turn.gif", "turn.png"):
        assert render_views("a.npz", out, turn) == [out]
    render_views("a.npz", "turn", turn)
    sheet = load("turn.png", Image).colour
    np.testing.assert_array_equal(sheet[:6, 12:20], load("turn/0001.png", Image).colour)
    with pytest.raises(OutputError, match=r"turn\.gif: exists already"):
        render_views("none", "turn.gif", turn)
    render_views("a.npz", PictureOutputs(out="turn.gif", force=True), turn)


@pytest.mark.usefixtures("folder")
def test_a_level_a_grid_and_a_mesh_change_what_is_seen() -> None:
    octree = build_octree(load("a.npz", N3Tree))
    save("l.svo.npz", cut_octree(octree, level=1))
    save("a.vdb", build_vdb(octree, grids=("density", "Cd")))
    save("m.obj", Meshes((cube(0.3),)))
    shot = ViewSelection(cameras="cameras.json")
    render_views("a.svo.pb", "level.png", shot, lod=1)
    render_views("l.svo.npz", "cut.png", shot)
    assert Path("level.png").read_bytes() == Path("cut.png").read_bytes()
    render_views("a.vdb", "whole.png", shot)
    render_views("a.vdb", "grey.png", shot, choice=GridChoice(grids=("density",)))
    render_views("a.npz", "alone.png", shot)
    render_views("a.npz", "mesh.png", shot, mesh=PlacedMesh(path="m.obj", how="ztest"))
    for one, other in (("whole", "grey"), ("alone", "mesh")):
        assert np.abs(load(f"{one}.png", Image).colour - load(f"{other}.png", Image).colour).max() > 0.1
    with pytest.raises(UsageError, match=r"a\.npz is not a volume; allowed: no `grid` and no `in_up`"):
        render_views("a.npz", "b.png", shot, choice=GridChoice(in_up="y"))


@pytest.mark.parametrize(
    ("pictures", "shots", "said"),
    [
        ("-", ViewSelection(turntable=3), "stdout takes one picture"),
        (PictureOutputs(out="-", alpha=True), ViewSelection(), "`depth` and `alpha` need a file for each picture"),
        (
            PictureOutputs(out="a.gif", depth="png"),
            ViewSelection(turntable=3),
            "`depth` and `alpha` need a file for each picture",
        ),
        ("a.gif", ViewSelection(), "has no file extension for a picture"),
        ("a.png", ViewSelection(cameras="c.json", turntable=3), "`turntable` and `cameras` both select the views"),
        (PictureOutputs(out="there.png", depth="npy"), ViewSelection(), "there.depth.npy: exists already"),
    ],
)
def test_what_arguments_alone_can_tell_is_told_before_anything_is_read(
    pictures: PictureOutputs | str, shots: ViewSelection, said: str, folder: Path
) -> None:
    (folder / "there.depth.npy").touch()
    with pytest.raises(NerfbakeError, match=re.escape(said)):
        render_views("none", pictures, shots)


def test_all_names_are_settled_before_the_first_picture(folder: Path) -> None:
    (folder / "views").mkdir()
    (folder / "views" / "0002.alpha.png").touch()
    with pytest.raises(OutputError, match=r"0002\.alpha\.png: exists already"):
        render_views("a.npz", PictureOutputs(out="views", alpha=True), ALL)
    assert [path.name for path in (folder / "views").iterdir()] == ["0002.alpha.png"]
    with pytest.raises(InvalidScene, match=r"^a.svo.pb: level is 9"):
        render_views("a.svo.pb", "b.png", lod=9)


def test_splats_are_rendered_and_options_of_fields_are_refused(folder: Path) -> None:
    save("s.ply", splats(300))
    assert render_views("s.ply", PictureOutputs(out="s.png", depth="npy"), ViewSelection(size=(40, 30))) == ["s.png"]
    assert 4 < load("s.depth.npy", Depth).distance.max() < 40
    for options in ({"lookup": "trilinear"}, {"transmittance_cut": 0.5}):
        with pytest.raises(UsageError, match="has no effect on splats"):
            render_views("s.ply", "t.png", **options)
    with pytest.raises(NerfbakeError, match="holds Gaussian splats"):
        render_views("s.ply", "t.png", mesh=PlacedMesh(path="a.glb"))


def test_triangles_are_rendered_as_any_scene(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    stage1 = sample_stage1(resolution=16)
    textured = Meshes(tuple(mesh for mesh in stage1.meshes if mesh is not None))
    save("a.glb", textured, quantised=True)
    save_folder("stage1", stage1)
    shots = ViewSelection(size=(24, 24), samples=2)
    for name, scene in (("a.glb", load("a.glb", Meshes)), ("stage1", load("stage1", Stage1))):
        render_views(name, PictureOutputs(out=f"{name}.png", depth="npy"), shots, background=(0, 0, 0))
        (camera,) = orbit_cameras(scene, width=24, height=24).cameras
        render = render_meshes if isinstance(scene, Meshes) else render_stage1
        wanted = render(scene, camera, samples=2, background=(0, 0, 0))  # type: ignore[arg-type]
        np.testing.assert_array_equal(load(f"{name}.png", Image).pixels, wanted.pixels)
        assert Path(f"{name}.depth.npy").exists()


def test_what_has_no_effect_on_triangles_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    save("a.obj", Meshes((cube(),)))
    with pytest.raises(UsageError, match="`lookup` has no effect on triangles; allowed: with a field"):
        render_views("a.obj", "a.png", lookup="trilinear")
    with pytest.raises(UsageError, match=r"a\.obj is not a volume"):
        render_views("a.obj", "a.png", choice=GridChoice(grids=("density",)))
    for more in ({"lod": 2}, {"mesh": PlacedMesh(path="a.obj")}):
        with pytest.raises(NerfbakeError, match="holds a mesh; allowed: "):
            render_views("a.obj", "a.png", **more)
    assert list(tmp_path.glob("*.png")) == []
