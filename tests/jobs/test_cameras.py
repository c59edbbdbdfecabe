"""Cameras of other tools in a fit, and written for other programs."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Camera, Cameras, catalog, load, save
from nerfbake.errors import InvalidScene, OutputError, UsageError
from nerfbake.jobs import FitOptions, Source, Target, convert_cameras, fit_file
from nerfbake.jobs.photographs import PhotographOptions, read_photographs
from nerfbake.scene.lens import Lens
from nerfbake.scene.sparse_points import SparsePoints
from tests.jobs.listener import Listener
from tests.support import camera_tools as tools
from tests.support.camera_tools import TOOLS
from tests.support.captures import Rig, rig, write_nerfstudio, write_pictures
from tests.support.panoramas import panorama_cameras
from tests.support.photographs import spot, write_picture, write_scene
from tests.support.reprojection import in_pycolmap, reprojection_errors

QUICK = FitOptions(epochs="cells=8,prune=0.03/cells=16,rays=1,prune=0.02", basis="SH1")


def many(frames: int) -> Rig:
    made = rig(odd=True)
    return replace(made, poses=made.poses[[0] * frames])


def pictured(folder: Path, made: Rig) -> Path:
    for i, name in enumerate(made.names):
        write_picture(folder / "images" / f"{name}.png", spot(made.width, made.height, i))
    return folder


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Rig]:
    """Pictures in `images`, and the rig that took them."""
    folder = tmp_path_factory.mktemp("scene")
    capture = write_scene(folder / "drawn", frames=10)
    cameras = load(capture / "transforms_train.json", Cameras).cameras
    place = folder / "capture"
    for i, camera in enumerate(cameras):
        (place / "images").mkdir(parents=True, exist_ok=True)
        shutil.copy(capture / f"{camera.picture}.png", place / "images" / f"r_{i}.png")
    one = cameras[0]
    poses = np.stack([camera.pose for camera in cameras])
    return place, Rig(one.width, one.height, one.fx, one.fy, one.cx, one.cy, poses)


@pytest.mark.slow
def test_a_capture_in_two_dialects_fits_to_the_same_bytes(scene: tuple[Path, Rig], tmp_path: Path) -> None:
    """Given by Metashape, and by the transforms.json that convert writes of it."""
    capture, made = scene
    one, other = (Path(shutil.copytree(capture, tmp_path / name)) for name in ("one", "other"))
    tools.write_metashape(one, made, calibration="<k1>0.01</k1><p1>0.002</p1>")
    convert_cameras(one, str(other / "transforms.json"))
    for name, folder in (("one.npz", one), ("other.npz", other)):
        fit_file(folder, str(tmp_path / name), options=QUICK)
    assert (tmp_path / "one.npz").read_bytes() == (tmp_path / "other.npz").read_bytes()
    assert load(one, Cameras).dialect == "Metashape"


@pytest.mark.parametrize("tool", TOOLS)
def test_pictures_of_every_tool_are_found(tool: str, tmp_path: Path, listener: Listener) -> None:
    whole = rig(odd=True)
    made = replace(tools.kept_by(tool, whole), poses=whole.poses[[0, 1, 2, 0]])
    write_pictures(tmp_path / "images", made)
    file = TOOLS[tool][0](tmp_path, made)
    for number, path in enumerate(sorted(tmp_path.rglob("*.png"))):
        write_picture(path, spot(made.width, made.height, number % 4))
    places = next(form.places for form in catalog.DIALECTS if form.name == tool)
    for source in (tmp_path / file, tmp_path)[: 2 if places else 1]:
        split = read_photographs(listener, Source(str(source)), PhotographOptions(holdout=4))
        assert (len(split.training.pictures), len(split.held_out.pictures)) == (3, 1)


def test_what_a_capture_holds_out_judges_the_fit(tmp_path: Path, listener: Listener) -> None:
    made = many(5)
    fields = json.loads((write_nerfstudio(pictured(tmp_path, made), made) / "transforms.json").read_text())
    fields["test_frames"] = [fields["frames"].pop(1), fields["frames"].pop(2)]
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    split = read_photographs(listener, Source(str(tmp_path)))
    assert [camera.name for camera in split.held_out.cameras.cameras] == ["r_1", "r_3"]
    assert [camera.name for camera in split.training.cameras.cameras] == ["r_0", "r_2", "r_4"]
    (tmp_path / "images" / "r_1.png").unlink()  # the others keep their parts
    split = read_photographs(listener, Source(str(tmp_path)))
    assert [camera.name for camera in split.held_out.cameras.cameras] == ["r_3"]
    split = read_photographs(listener, Source(str(tmp_path)), PhotographOptions(holdout=2))
    assert len(split.held_out.pictures) == 2


def test_files_of_cameras_that_are_not_read_are_named(tmp_path: Path, listener: Listener) -> None:
    made = many(5)
    write_nerfstudio(pictured(tmp_path, made), made)
    tools.write_metashape(tmp_path, made)
    tools.write_open3d(tmp_path, made)
    (tmp_path / "intrinsics.txt").unlink()
    (tmp_path / "cameras.abc").write_bytes(b"Ogawa")
    read_photographs(listener, Source(str(tmp_path)))
    said = [line.removeprefix(f"{tmp_path}: ") for line in listener.said if "is not read" in line]
    assert said == [
        "cameras.xml of Metashape is not read: transforms.json is read instead",
        "trajectory.log of Open3D is not read: its poses need intrinsics.txt or calib.txt beside it",
        "cameras.abc of Alembic is not read: nerfbake reads Meshroom's cameras.sfm",
    ]


def test_files_that_are_read_together_are_not_named(tmp_path: Path, listener: Listener) -> None:
    made = many(5)
    pictured(tmp_path, made)
    tools.write_realitycapture(tmp_path, made)
    read_photographs(listener, Source(str(tmp_path)))
    assert not [line for line in listener.said if "is not read" in line]


# -- convert ---------------------------------------------------------------------------------------------------
def test_transforms_have_the_rays_of_their_source_to_the_bit(tmp_path: Path) -> None:
    made = rig(odd=True)
    write_pictures(tmp_path / "images", made)
    file = tools.write_metashape(tmp_path, made, calibration="<k1>0.01</k1><k4>1e-3</k4><p1>0.002</p1>")
    convert_cameras(tmp_path / file, str(tmp_path / "transforms.json"))
    fields = json.loads((tmp_path / "transforms.json").read_text())
    assert [frame["file_path"] for frame in fields["frames"]] == [f"images/r_{i}.png" for i in range(3)]
    assert (fields["camera_model"], fields["k4"], fields["p2"]) == ("OPENCV", 1e-3, 0.002)
    for one, other in zip(load(tmp_path / file, Cameras).cameras, load(tmp_path, Cameras).cameras, strict=True):
        assert one.rays()[1].tobytes() == other.rays()[1].tobytes()


LENSES: dict[str, Lens | None] = {
    "PINHOLE": None,
    "OPENCV": Lens("polynomial", (0.01, -0.002), (0.001, 0.002)),
    "FULL_OPENCV": Lens("polynomial", (0.01, -0.002, 0.003), (0.001, 0.002)),
    "OPENCV_FISHEYE": Lens("fisheye", (0.01, -0.002, 0.003, 0.004)),
}


@pytest.mark.parametrize("model", LENSES)
def test_a_model_of_colmap_has_the_rays_of_its_source(model: str, tmp_path: Path) -> None:
    made = rig(odd=True)
    lens = LENSES[model]
    poses = list(made.poses)
    cameras = [
        Camera(14, 10, (made.fx, made.fy), pose, f"r_{i}", (6.125, 5.5), lens, f"images/a/r_{i}.png")
        for i, pose in enumerate(poses)
    ]
    save(tmp_path / "given.json", Cameras(tuple(cameras)))
    target = Target(str(tmp_path / "model" / "sparse" / "0"), to="colmap")
    convert_cameras(tmp_path / "given.json", target)
    assert f" {model} 14 10 " in (tmp_path / "model" / "sparse" / "0" / "cameras.txt").read_text()
    for one, other in zip(cameras, load(tmp_path / "model", Cameras).cameras, strict=True):
        np.testing.assert_allclose(one.pose, other.pose, rtol=0, atol=1e-14)
        np.testing.assert_allclose(one.rays()[1], other.rays()[1], rtol=0, atol=1e-14)
    with pytest.raises(OutputError, match="exists already"):
        convert_cameras(tmp_path / "given.json", target)
    convert_cameras(tmp_path / "given.json", target._replace(force=True))


@pytest.mark.slow
def test_pycolmap_sees_the_points_of_a_model_where_we_do(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made = rig(odd=True)
    ahead = made.poses[0] @ [0.1, -0.2, -3, 1]
    camera = Camera(14, 10, (17.5, 16.25), made.poses[0], "r_0", (6.125, 5.5), LENSES["OPENCV"], "images/r_0.png")
    places = SparsePoints(ahead[None, :3], np.array([0]), np.array([0]), np.array([[7.0, 6.5]]))
    given = Cameras((camera,), points=places)
    monkeypatch.setattr("nerfbake.jobs.cameras.read_cameras", lambda steps, path: given)
    convert_cameras(tmp_path / "any", Target(str(tmp_path / "model"), to="colmap"))
    code = """
import json, sys, pycolmap
model = pycolmap.Reconstruction(json.load(sys.stdin))
model.update_point_3d_errors()
print(model.compute_mean_reprojection_error())
"""
    found = float(in_pycolmap(code, str(tmp_path / "model")))
    assert found == pytest.approx(float(reprojection_errors(given)[0]), rel=0.02)


def test_what_has_no_place_is_said(tmp_path: Path, listener: Listener) -> None:
    made = rig(odd=True)
    write_pictures(tmp_path / "images", made)
    file = tmp_path / tools.write_metashape(tmp_path, made, calibration="<b2>0.5</b2><k1>0.01</k1>")
    convert_cameras(
        file, Target("cameras.json", to="3dgs", force=True)._replace(path=str(tmp_path / "c.json")), steps=listener
    )
    text = "\n".join(listener.said)
    assert "the skew is left out, which moves points by up to 0.17 px" in text
    assert "the lenses of 3 cameras are left out" in text
    assert "the principal points are left out, up to 1 px from the middle" in text
    assert load(tmp_path / "c.json", Cameras).dialect == "3D Gaussian Splatting"
    eight = tmp_path / tools.write_metashape(tmp_path, made, calibration="<k4>0.01</k4>")
    with pytest.raises(InvalidScene, match=r"k4 = 0\.01; allowed: k1 to k3: COLMAP has no model with r\^8"):
        convert_cameras(eight, Target(str(tmp_path / "m"), to="colmap"))
    assert not (tmp_path / "m").exists()


WIDE = Lens("fisheye", (0.01,))
RATIONAL = Lens("rational", (0.01, 0.0, 0.0, 0.01))


@pytest.mark.parametrize(
    ("lenses", "said"),
    [
        ((None, LENSES["OPENCV"]), ""),
        ((WIDE, Lens("fisheye", (0.02,))), ""),
        ((WIDE, None, WIDE), "one camera_model for all frames, and takes the 2 cameras with a fisheye"),
        ((WIDE, RATIONAL), "one camera_model for all frames, and takes the 1 camera with a fisheye"),
        ((RATIONAL, RATIONAL), "nerfstudio does not read FULL_OPENCV, the lens of 2 cameras; nerfbake does"),
    ],
)
def test_a_lens_that_nerfstudio_misreads_is_said(
    lenses: tuple[Lens | None, ...], said: str, tmp_path: Path, listener: Listener
) -> None:
    cameras = (Camera(14, 10, 17.5, np.eye(4), str(i), None, lens) for i, lens in enumerate(lenses))
    save(tmp_path / "given.json", Cameras(tuple(cameras)))
    convert_cameras(tmp_path / "given.json", str(tmp_path / "t.json"), steps=listener)
    warned = [line for line in listener.said if "warning" in line]
    assert (said in "\n".join(warned)) if said else not warned


def test_cameras_on_a_map_are_written_near_their_origin(tmp_path: Path, listener: Listener) -> None:
    made = rig(odd=True)
    poses = made.poses.copy()
    poses[:, :3, 3] += [453_000, 5_012_345, 120]
    away = Rig(14, 10, 17.5, 17.5, 7, 5, poses)
    file = tmp_path / tools.write_gaussians(tmp_path, away)
    convert_cameras(file, str(tmp_path / "t.json"), steps=listener)
    (said,) = [line for line in listener.said if "relative to the origin" in line]
    origin = np.array([float(value) for value in said.split("origin ")[1].split(",")[0].split()])
    for one, other in zip(poses, load(tmp_path / "t.json", Cameras).cameras, strict=True):
        np.testing.assert_allclose(one[:3, 3] - origin, other.pose[:3, 3], atol=1e-8)


REFUSED: dict[str, tuple[Callable[[Path], Any], type[Exception], str]] = {
    "another ending": (lambda path: str(path / "a.xml"), UsageError, "is not a file of cameras"),
    "a folder on stdout": (lambda path: Target("-", to="colmap"), UsageError, "stdout cannot be written as colmap"),
}


@pytest.mark.parametrize("name", REFUSED)
def test_other_outputs_are_refused(name: str, tmp_path: Path) -> None:
    target, error, said = REFUSED[name]
    file = tmp_path / tools.write_metashape(tmp_path, rig(odd=True))
    with pytest.raises(error, match=said):
        convert_cameras(file, target(tmp_path))


def test_test_frames_stay_held_out(tmp_path: Path) -> None:
    made = many(4)
    fields = json.loads((write_nerfstudio(tmp_path, made) / "transforms.json").read_text())
    fields["test_frames"] = [fields["frames"].pop()]
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    convert_cameras(tmp_path, str(tmp_path / "again.json"))
    assert load(tmp_path / "again.json", Cameras).held_out == (3,)


def test_panoramas_have_no_place_in_cameras_json(tmp_path: Path, listener: Listener) -> None:
    save(tmp_path / "t.json", panorama_cameras(3, 64))
    with pytest.raises(InvalidScene, match=r"camera 00 shows all directions; allowed: a pinhole"):
        convert_cameras(tmp_path / "t.json", Target(str(tmp_path / "c.json"), to="3dgs"), steps=listener)
    assert not (tmp_path / "c.json").exists()
    assert not any("left out" in text for text in listener.said)
