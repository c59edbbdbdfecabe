"""`nerfbake render` as a shell sees it."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Cameras, Depth, Meshes, build_field, build_octree, build_vdb, load, orbit_cameras, save
from nerfbake.cli.main import run
from tests.conftest import DATA, Shell
from tests.support.captures import rig, write_colmap_binary
from tests.support.meshes import cube
from tests.support.scenes import n3tree

HOSTILE = sorted(path.name for path in (DATA / "hostile").glob("*.json") if ".svo." not in path.name)


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    tree = n3tree(splits=[(0, (1, 0, 1))], data_format="SH4")
    save(tmp_path / "a.npz", tree)
    save(tmp_path / "a.svo.pb", build_octree(tree))
    save(tmp_path / "a.nvdb", build_vdb(build_octree(tree), grids=("index",)))
    save(tmp_path / "transforms.json", orbit_cameras(build_field(tree), frames=3, width=20, height=16))
    return tmp_path


def test_pictures(shell: Shell, scene: Path) -> None:
    assert shell("render", "a.npz", "--out", "a.png", "--size", "30x20").returncode == 0
    with Pillow.open(scene / "a.png") as picture:
        assert (picture.size, picture.mode) == ((30, 20), "RGB")
        assert np.asarray(picture).std() > 5
    done = shell("render", "a.svo.pb", "--cameras", "transforms.json", "--all", "--out", "views")
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in (scene / "views").iterdir()) == ["0000.png", "0001.png", "0002.png"]
    # An octree at the tree's own resolution is the tree; and stdout takes a picture, too.
    one = shell("render", "a.npz", "--cameras", "transforms.json", "--frame", "1", "--out", "-", "-q").stdout
    with Pillow.open(io.BytesIO(one)) as a, Pillow.open(scene / "views" / "0001.png") as b:
        assert np.abs(np.asarray(a).astype(int) - np.asarray(b)).max() <= 1
    assert shell("render", "a.npz", "--turntable", "4", "--size", "8x8", "--out", "turn").returncode == 0
    assert len(list((scene / "turn").iterdir())) == 4
    clear = shell(
        "render", "a.svo.pb", "--lod", "1", "--background", "transparent", "--size", "9x9", "--out", "-"
    ).stdout
    with Pillow.open(io.BytesIO(clear)) as picture:
        assert picture.mode == "RGBA"


def test_rays_a_pixel(scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    monkeypatch.chdir(scene)
    save("four.json", replace(load("transforms.json", Cameras), samples=2))
    seen = {}
    for cameras, given in product(("transforms.json", "four.json"), ("", "1", "2")):
        more = ["--samples", given] if given else []
        assert run(["render", "a.npz", "--cameras", cameras, *more, "--out", "a.png", "--force"]) == 0
        several = given == "2" or (not given and cameras == "four.json")
        assert (", 2x2 rays a pixel" in capsys.readouterr().err) == several
        seen[cameras, given] = Path("a.png").read_bytes()
    one, four = seen["transforms.json", ""], seen["four.json", ""]
    assert one != four
    assert seen["transforms.json", "1"] == seen["four.json", "1"] == one
    assert seen["transforms.json", "2"] == seen["four.json", "2"] == four
    assert run(["render", "a.npz", "--turntable", "2", "--size", "8x8", "--samples", "3", "--out", "turn.gif"]) == 0
    assert capsys.readouterr().err.startswith("turn.gif: animation of 2 pictures of 8x8, 3x3 rays a pixel, ")
    save("m.glb", Meshes((cube(0.3),)))
    for how in ("stop", "ztest"):
        mesh = ["--mesh", "m.glb", "--composite", how, "--samples", "2", "--size", "8x8"]
        assert run(["render", "a.npz", "--out", f"{how}.png", *mesh]) == 0


def test_a_mesh_in_the_picture(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(scene)
    pictures = []
    for name, more in (("a", []), ("b", ["--mesh", "m.glb"]), ("c", ["--mesh", "m.obj", "--composite", "ztest"])):
        if more:
            save(more[1], Meshes((cube(0.3),)))
        assert run(["render", "a.npz", "--size", "24x24", "--out", f"{name}.png", "-q", *more]) == 0
        with Pillow.open(f"{name}.png") as picture:
            pictures.append(np.asarray(picture).astype(int))
    alone, stopped, tested = pictures
    assert np.abs(stopped - alone).max() > 50
    assert np.abs(tested - alone).max() > 50
    np.testing.assert_array_equal(stopped[0], alone[0])  # the cube is in the middle
    Path("none.obj").write_text("v 0 0 0\n")
    assert run(["render", "a.npz", "--mesh", "none.obj", "--out", "m.png"]) == 1
    assert capsys.readouterr().err == "error: none.obj: the mesh has no faces; allowed: at least one triangle\n"
    assert not Path("m.png").exists()


def test_depth_and_alpha_stand_beside_the_picture(shell: Shell, scene: Path) -> None:
    arguments = ["render", "a.nvdb", "--cameras", "transforms.json", "--lookup", "trilinear", "--alpha"]
    assert shell(*arguments, "--out", "a.png", "--depth").returncode == 0
    assert shell(*arguments, "--all", "--out", "views", "--depth", "npy", "-q").returncode == 0
    assert sorted(path.name for path in (scene / "views").glob("0002*")) == [
        "0002.alpha.png",
        "0002.depth.npy",
        "0002.png",
    ]
    exact = np.load(scene / "views" / "0000.depth.npy")
    with Pillow.open(scene / "a.depth.png") as steps, Pillow.open(scene / "a.alpha.png") as alpha:
        assert np.abs(np.asarray(steps) / 1000 - exact).max() < 1e-3
        met = np.asarray(alpha.convert("L")) > 0
    assert met.any()
    assert exact[met].min() > 0
    assert load(scene / "a.depth.png", Depth).distance.shape == (16, 20)
    done = shell(*arguments, "--out", "a.png", "--depth", "npy")
    assert done.returncode == 4
    assert done.stderr.decode() == "error: a.png: exists already; allowed: a new file, or --force\n"
    assert not (scene / "a.depth.npy").exists()


def test_a_turntable_moves_or_is_a_sheet(shell: Shell, scene: Path) -> None:
    turn = ["render", "a.npz", "--turntable", "5", "--size", "24x20"]
    done = shell(*turn, "--out", "turn.gif")
    size = (scene / "turn.gif").stat().st_size
    assert done.stderr.decode() == f"turn.gif: animation of 5 pictures of 24x20, {size:,} bytes\n"
    with Pillow.open(scene / "turn.gif") as moving:
        assert (moving.format, moving.size, getattr(moving, "n_frames", 1)) == ("GIF", (24, 20), 5)
    assert shell(*turn, "--out", "turn.png").returncode == 0
    assert shell(*turn, "--out", "turn").returncode == 0
    with Pillow.open(scene / "turn.png") as sheet:
        assert sheet.size == (3 * 28 - 4, 2 * 24 - 4)
        pixels = np.asarray(sheet)
    for i in range(5):
        x, y = i % 3 * 28, i // 3 * 24
        with Pillow.open(scene / "turn" / f"{i:04d}.png") as picture:
            assert (pixels[y : y + 20, x : x + 24] == np.asarray(picture)).all()
    # Nothing is replaced without being told to; told to, the same comes out.
    before = (scene / "turn.gif").read_bytes()
    assert shell(*turn, "--out", "turn.gif").returncode == 4
    assert shell(*turn, "--out", "turn.gif", "--force").returncode == 0
    assert (scene / "turn.gif").read_bytes() == before


def test_cameras_of_a_folder_say_where_they_are_from(shell: Shell, scene: Path) -> None:
    write_colmap_binary(scene / "capture", rig(odd=True))
    (scene / "capture" / "transforms_train.json").write_text("{}")  # no dialect: the folder's first is taken
    done = shell("render", "a.npz", "--cameras", "capture", "--frame", "2", "--out", "a.png")
    assert done.returncode == 1
    assert b"capture: frames are missing" in done.stderr
    (scene / "capture" / "transforms_train.json").unlink()
    for given in ("capture", "capture/sparse/0/images.bin"):
        done = shell("render", "a.npz", "--cameras", given, "--frame", "2", "--out", "a.png", "--force")
        assert done.returncode == 0, done.stderr
        source = "sparse/0/images.bin" if given == "capture" else "images.bin"
        assert done.stderr.decode().splitlines()[0] == f"{given}: 3 cameras (COLMAP) from {source}"
    with Pillow.open(scene / "a.png") as picture:
        assert picture.size == (14, 10)
    quiet = shell("render", "a.npz", "--cameras", "capture", "--out", "a.png", "--force", "-q")
    assert quiet.stderr == b""


def test_what_was_taken_for_granted_is_said(shell: Shell, scene: Path) -> None:
    frame = {"file_path": "gone", "transform_matrix": np.eye(4).tolist()}
    (scene / "t.json").write_text(json.dumps({"camera_angle_x": 1, "frames": [frame]}))
    done = shell("render", "a.npz", "--cameras", "t.json", "--size", "9x9", "--out", "a.png")
    assert done.returncode == 0
    note = "t.json: no size and no picture for 1 of its cameras; using 800x800, the size of the Blender scenes"
    assert done.stderr.decode().splitlines()[0] == note


def test_all_names_are_settled_before_the_first_picture(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(scene)

    def cameras(*names: str) -> None:
        frames = [{"file_path": name, "transform_matrix": np.eye(4).tolist()} for name in names]
        Path("t.json").write_text(json.dumps({"camera_angle_x": 1, "w": 8, "h": 8, "frames": frames}))

    arguments = ["render", "a.npz", "--cameras", "t.json", "--all", "--out", "views", "-q"]
    cameras("../x", "a\0b", "-rf", "train/v", "test/v", "w.alpha", "w" * 999)
    assert run(arguments) == 0
    names = ["_rf", "a_b", "v", "v_0004", "w.alpha", "w" * 120, "x"]
    assert sorted(path.name for path in Path("views").iterdir()) == sorted(f"{name}.png" for name in names)
    # A picture's alpha would have the name of another picture.
    cameras("w", "w.alpha")
    assert run([*arguments, "--alpha", "--force"]) == 4
    assert "views/w.alpha.png: would be written twice; allowed: a unique name" in capsys.readouterr().err
    assert not Path("views/w.png").exists()
    # The last one is there, and the first is not made.
    cameras("new", "v")
    assert run(arguments) == 4
    assert not Path("views/new.png").exists()
    Path("file").write_text("")
    assert run([*arguments[:-2], "file/deeper", "-q"]) == 4
    assert "file: is not a folder; allowed: a new or another folder" in capsys.readouterr().err
    Path("turn").mkdir()
    Path("turn/0003.png").write_text("")
    assert run(["render", "a.npz", "--turntable", "4", "--size", "8x8", "--out", "turn"]) == 4
    assert [path.name for path in Path("turn").iterdir()] == ["0003.png"]


def test_a_lens_that_does_not_cover_the_picture_is_told_before_the_first(
    scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(scene)
    frames = [{"file_path": f"r_{i}", "transform_matrix": np.eye(4).tolist(), "k1": -float(i)} for i in range(2)]
    Path("t.json").write_text(json.dumps({"fl_x": 8, "w": 8, "h": 8, "frames": frames}))
    for command in (["render", "a.npz", "--all", "--out", "views"], ["compare", "a.npz", "a.svo.pb"]):
        assert run([*command, "--cameras", "t.json"]) == 1
        (line,) = capsys.readouterr().err.splitlines()
        assert "camera r_1 shows nothing at pixel 0, 0" in line
    assert not Path("views").exists()
    assert run(["check", "t.json"]) == 1
    assert run(["render", "a.npz", "--cameras", "t.json", "--out", "a.png", "-q"]) == 0  # the first has no fault


@pytest.mark.parametrize("name", HOSTILE)
@pytest.mark.data
def test_hostile_cameras_are_one_line(
    name: str, data: Path, scene: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(scene)
    code = run(["render", "a.npz", "--cameras", str(data / "hostile" / name), "--all", "--out", "views", "-q"])
    said = capsys.readouterr().err.splitlines()
    assert (code, len(said)) in ((0, 0), (1, 1))
    made = [path.name for path in Path("views").iterdir()] if Path("views").exists() else []
    assert len(made) == (3 if code == 0 else 0)


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["a.npz"], 2, "Missing option '--out'"),
        (["a.npz", "--out", "a.bmp"], 2, "has no file extension for a picture; allowed: .png"),
        (["a.npz", "--out", "a.png", "--background", "blue"], 2, "'blue' is not a colour; allowed: white"),
        (["a.npz", "--out", "a.png", "--size", "0x9"], 2, "'0x9' is not a size"),
        (
            ["a.npz", "--out", "a.png", "--lod", "2"],
            1,
            "a PlenOctree (`nerfbake svo` makes an octree of it); allowed: an octree",
        ),
        (["a.svo.pb", "--out", "a.png", "--lod", "9"], 1, "a.svo.pb: level is 9; allowed: 0 to 2"),
        (
            ["transforms.json", "--out", "a.png"],
            1,
            "holds cameras (--cameras takes them); allowed: a PlenOctree or a volume",
        ),
        (["a.npz", "--out", "-", "--depth"], 2, "--depth and --alpha need a file for each picture; allowed: a .png"),
        (["a.npz", "--turntable", "3", "--out", "a.gif", "--alpha"], 2, "--depth and --alpha need a file for each"),
        (["a.npz", "--out", "a.png", "--depth", "exr"], 2, "'exr' is not one of 'png', 'npy'"),
        (["a.npz", "--out", "a.gif"], 2, "has no file extension for a picture; allowed: .png"),
        (
            ["a.npz", "--turntable", "3", "--cameras", "t.json", "--out", "a.gif"],
            2,
            "--turntable and --cameras both select",
        ),
        (["a.npz", "--turntable", "3", "--out", "a.mp4"], 2, "'a.mp4' has no file extension for several pictures"),
        (["a.npz", "--turntable", "3", "--out", "-"], 2, "stdout takes one picture; allowed for several"),
        (
            ["a.npz", "--turntable", "9", "--out", "a.gif", "--max-memory", "1MB"],
            1,
            "a.gif: keeping 9 pictures at",
        ),
        (["a.npz", "--out", "a.png", "--cameras", "a.npz"], 1, "holds a PlenOctree; allowed: cameras"),
        (
            ["a.npz", "--out", "a.png", "--cameras", "transforms.json", "--frame", "7"],
            2,
            "--frame is 7; allowed: 0 to 2",
        ),
        (["a.npz", "--out", "a.png", "--cameras", "bad.json"], 1, "bad.json: camera_angle_x is missing"),
    ],
)
def test_what_goes_wrong_is_one_line(shell: Shell, scene: Path, arguments: list[str], code: int, said: str) -> None:
    (scene / "bad.json").write_text(json.dumps({"frames": [{"transform_matrix": np.eye(4).tolist()}]}))
    done = shell("render", *arguments)
    (line,) = done.stderr.decode().splitlines()
    assert said in line
    assert done.returncode == code
    assert not (scene / "a.png").exists()
    assert not list(scene.glob("*.gif*"))
