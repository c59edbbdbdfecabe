"""A distance between two points of a scene, which photographs show."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Cameras, load
from nerfbake.errors import InvalidScene, NerfbakeError, UsageError
from nerfbake.jobs import WorldOptions, convert_cameras, write_sample_capture
from nerfbake.jobs.known_distance import parse_distance
from nerfbake.jobs.poses import find_poses
from nerfbake.jobs.world import MovedWorld, find_world
from nerfbake.kernels.arrays import Floats
from tests.jobs.listener import Listener

ENDS = np.array([[0.1, -0.2, 0.3], [-0.4, 0.1, -0.1]])  # of a ruler


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("known") / "capture"
    write_sample_capture(folder, frames=6, edge=64, room=True)
    return folder


@pytest.fixture
def cameras(capture: Path) -> Cameras:
    return load(capture, Cameras)


def pixel(frame: dict[str, object], meta: dict[str, float], point: Floats) -> str:
    """NAME:X:Y of a point, by what transforms.json says alone."""
    to_camera = np.linalg.inv(np.array(frame["transform_matrix"]))
    x, y, z = (to_camera @ np.append(point, 1))[:3]
    focal = meta["w"] / 2 / np.tan(meta["camera_angle_x"] / 2) if "camera_angle_x" in meta else meta["fl_x"]
    name = Path(str(frame["file_path"])).stem
    return f"{name}:{meta['w'] / 2 + focal * x / -z:.6f}:{meta['h'] / 2 - focal * y / -z:.6f}"


def ruler(capture: Path, *frames: int, ends: Floats = ENDS) -> str:
    meta = json.loads((capture / "transforms.json").read_text())
    return ",".join("+".join(pixel(meta["frames"][i], meta, end) for i in frames) for end in ends)


def moved_by(cameras: Cameras, scale: str, photographs: Sequence[Path | None] = ()) -> MovedWorld:
    moved = find_world(Listener(), "in", cameras, WorldOptions(scale=scale), photographs)
    assert moved is not None
    return moved


def test_the_ruler_has_its_length(capture: Path, tmp_path: Path) -> None:
    listener = Listener()
    points = ruler(capture, 0, 2)
    written = convert_cameras(
        capture, tmp_path / "metres.json", world=WorldOptions(scale=f"{points}=30cm"), steps=listener
    )
    scale = 0.3 / np.linalg.norm(ENDS[0] - ENDS[1])
    assert written.eyes == pytest.approx(scale * load(capture, Cameras).eyes, rel=1e-5)
    again = json.loads((tmp_path / "metres.json").read_text())
    assert again["world"]["metres"] is True
    first, second = points.split(",")
    short = [re.sub(r"\d+\.\d+", lambda number: f"{float(number[0]):g}", each) for each in (first, second)]
    assert f"by 0.3 m between {short[0]} and {short[1]}, whose rays miss each other by up to" in "".join(listener.said)


def test_three_photographs_and_a_place_are_points_too(capture: Path, cameras: Cameras) -> None:
    frame = moved_by(cameras, f"{ruler(capture, 0, 2, 3)}=2m").frame
    assert frame.scale == pytest.approx(2 / np.linalg.norm(ENDS[0] - ENDS[1]), rel=1e-5)
    (shown,) = ruler(capture, 0, 2, ends=ENDS[:1]).split(",")
    frame = moved_by(cameras, f"0001,{shown}=2m").frame
    assert frame.scale == pytest.approx(2 / np.linalg.norm(cameras.eyes[1] - ENDS[0]), rel=1e-5)


@pytest.mark.parametrize("size", [(64, 64), (128, 128), (129, 129), (32, 32)])
def test_pixels_are_those_of_the_photograph(size: tuple[int, int], cameras: Cameras, tmp_path: Path) -> None:
    """fit reduces large pictures, and a capture may have smaller ones than its cameras."""
    width, height = size
    Pillow.new("RGB", size).save(tmp_path / "a.png")
    whole = Cameras(tuple(replace(camera.resized(*size), lens=None) for camera in cameras.cameras))
    focal = whole.cameras[0].fx
    texts = []
    for end in ENDS:
        seen = []
        for number in (0, 2):
            pose = whole.cameras[number].pose
            x, y, z = pose[:3, :3].T @ (end - pose[:3, 3])
            seen.append(f"000{number}:{width / 2 + focal * x / -z:.6f}:{height / 2 - focal * y / -z:.6f}")
        texts.append("+".join(seen))
    reduced = replace(whole, cameras=tuple(camera.reduced(2) for camera in whole.cameras))
    for given in (cameras, reduced) if size != (129, 129) else (reduced,):
        frame = moved_by(given, f"{','.join(texts)}=1m", [tmp_path / "a.png"] * 6).frame
        assert frame.scale == pytest.approx(1 / np.linalg.norm(ENDS[0] - ENDS[1]), rel=1e-5)


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("0000:1:2+nobody:3:4,0001=1m", "'nobody' of `scale` names no camera; allowed: a photograph such as 0000"),
        (
            "0000:65:2+0001:3:4,0001=1m",
            "'0000:65:2' of `scale` is outside of the picture; allowed: 0 to 64 and 0 to 64",
        ),
        ("0000:-1:2+0001:3:4,0001=1m", "'0000:-1:2' of `scale` is outside of the picture"),
        ("0000:1:2+0000:3:4,0001=1m", "'0000:1:2+0000:3:4' of `scale` has a photograph twice; allowed: two different"),
    ],
)
def test_what_no_photograph_shows_is_refused(text: str, error: str, cameras: Cameras) -> None:
    with pytest.raises(UsageError, match=re.escape(error)):
        moved_by(cameras, text)


def test_rays_that_are_not_of_one_point_are_refused(capture: Path, cameras: Cameras) -> None:
    first, _ = ruler(capture, 0, 2).split(",")
    name, x, y = first.rsplit(":", 2)
    with pytest.raises(InvalidScene, match=r"rays miss each other by \S+ pixels in 0000; allowed: up to 2"):
        moved_by(cameras, f"{name}:{x}:{float(y) + 12:.6f},0001=1m")
    with pytest.raises(InvalidScene, match="are at the same place"):
        moved_by(cameras, f"{first},{first}=1m")


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("a:1:2,b=1m", "has one photograph of 'a:1:2'; allowed: two or more"),
        ("a:1:2+b:3:4,b=1km", "the distance of `scale` is '1km'; allowed: 1e-6 to 1e9 m, with m, cm or mm"),
        ("a:1:2+b:3:4=1m", "allowed: gps, none, or POINT"),
        ("a:1:2+b:3:4,c=0", "the distance of `scale` is '0'; allowed: "),
    ],
)
def test_what_is_no_point_is_refused(text: str, error: str) -> None:
    with pytest.raises(UsageError, match=re.escape(error)):
        parse_distance(text)


def test_names_may_have_the_signs_of_the_grammar() -> None:
    first, second, metres = parse_distance("a+b:c.jpg:1:2.5+d=e.jpg:0.5:3, f:g.jpg=35 mm")
    assert [str(first), str(second), metres] == ["a+b:c.jpg:1:2.5+d=e.jpg:0.5:3", "f:g.jpg", 0.035]


def test_a_wrong_pixel_is_named_before_poses_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.jobs.poses.require_installed", lambda *_: None)
    (tmp_path / "images").mkdir()
    for i in range(3):
        Pillow.new("RGB", (8, 6)).save(tmp_path / "images" / f"{i}.png")
    for name, error in (
        ("images/1.png:9:1", "outside of the picture; allowed: 0 to 8 and 0 to 6"),
        ("4:1:1", "names no"),
    ):
        listener = Listener()
        with pytest.raises(NerfbakeError, match=error):
            find_poses(tmp_path, world=WorldOptions(scale=f"{name}+0:1:1,2=1m"), steps=listener)
        assert listener.phases == ["reading 3 pictures"]


@pytest.mark.data
def test_points_of_a_real_model_have_their_distance(data: Path) -> None:
    """COLMAP placed these points by all pictures that see them; two are enough to 0.5 % of their distance."""
    cameras = load(data / "captures" / "plush", Cameras)
    points = cameras.points
    assert points is not None
    assert cameras.cameras[0].bends
    chosen = np.argsort(-np.bincount(points.point, minlength=len(points)), kind="stable")[:2]  # seen by the most
    texts = []
    for number in chosen:
        seen = np.flatnonzero(points.point == number)
        some = seen[[0, len(seen) // 2]]
        names = [Path(cameras.cameras[i].picture).stem for i in points.camera[some]]
        texts.append("+".join(f"{n}:{x:.3f}:{y:.3f}" for n, (x, y) in zip(names, points.pixel[some], strict=True)))
    frame = moved_by(cameras, f"{','.join(texts)}=1m").frame
    known = np.linalg.norm(np.subtract(*points.positions[chosen]))
    assert frame.scale * known == pytest.approx(1, abs=0.005)
