"""NSVF's intrinsics.txt in every layout: a matrix is read as a matrix, or refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake import Cameras, load
from nerfbake.errors import InvalidFile
from nerfbake.scene.camera import Camera
from tests.support.heic import heic_of

POSE = "1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n"
NO_PICTURE = "no picture in rgb; using 800x600, with the principal point in the centre"


def read(folder: Path, intrinsics: str) -> Camera:
    (folder / "pose").mkdir(exist_ok=True)
    (folder / "pose" / "a.txt").write_text(POSE)
    (folder / "intrinsics.txt").write_text(intrinsics)
    (camera,) = load(folder, Cameras).cameras
    return camera


@pytest.mark.parametrize(
    "text",
    [
        "875 0 400 0\n0 870 300 0\n0 0 1 0\n",  # 3 x 4: cx = 0 and cy = 400 were read
        "875 0 400 0\n0 870 300 0\n0 0 1 0\n0 0 0 1\n",
        "875 0 400\n\n0 870 300\n\n0 0 1\n",
        "875 0 400 0 0 870 300 0 0 0 1 0 0 0 0 1\n",
        "\ufeff875 0 400 0\n0 870 300 0\n0 0 1 0\n800 600\n",
    ],
)
def test_every_matrix_has_the_same_camera(text: str, tmp_path: Path) -> None:
    camera = read(tmp_path, text)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (875, 870, 400, 300)


def test_hidden_files_beside_the_poses_are_skipped(tmp_path: Path) -> None:
    (tmp_path / "pose").mkdir()
    (tmp_path / "pose" / "._a.txt").write_bytes(b"\0\5\x16\7\xff")  # macOS writes these to drives of other systems
    assert read(tmp_path, "875 400 300 0\n").picture == "rgb/a"


@pytest.mark.parametrize("text", ["875 400 300 0.\n0. 0. 0.\n0.\n1.\n800 800\n", "875 400 300\n", "875 400 300 0\n"])
def test_a_first_line_has_one_focal_length(text: str, tmp_path: Path) -> None:
    camera = read(tmp_path, text)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (875, 875, 400, 300)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("875 0 400\n0 870 300\n0 0 2\n", r"K\[2, 2\] is 2; allowed: 1"),
        ("875 0 400 0\n0 870 300 0\n0 0 0 0\n0 0 0 1\n", r"K\[2, 2\] is 0; allowed: 1"),
        ("875 0 400 9\n0 870 300 0\n0 0 1 0\n", r"K\[0, 3\] is 9; allowed: 0"),
        ("875 0 400\n3 870 300\n0 0 1\n", r"K\[1, 0\] is 3; allowed: 0"),
        ("875 2 400 0\n0 870 300 0\n0 0 1 0\n", "skew is 2; allowed: 0"),
        ("875 0 400 0\n0 870 300 0\n", "has lines of 4, 4 numbers; allowed: 4 x 4, 3 x 4, 3 x 3, or a first line"),
        ("875 0 400\n0 870 300\n0 0 1\n0 0 0\n", "has lines of 3, 3, 3, 3 numbers"),
        ("875 0 400 0 870 300 0 0 1\n", "has lines of 9 numbers"),
        ("", "has lines of no numbers"),
    ],
)
def test_what_is_no_matrix_of_a_pinhole_is_refused(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match=rf"intrinsics\.txt:? {said}"):
        read(tmp_path, text)


def test_pictures_that_cannot_be_read_are_not_called_missing(tmp_path: Path) -> None:
    read(tmp_path, "875 400 300 0\n")
    assert load(tmp_path, Cameras).notes == (NO_PICTURE,)
    (tmp_path / "rgb").mkdir()
    (tmp_path / "rgb" / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n")
    unreadable = "no readable picture in rgb (rgb/a.png cannot be read)"
    assert load(tmp_path, Cameras).notes == (NO_PICTURE.replace("no picture in rgb", unreadable),)


def test_the_size_of_a_large_heic_is_found(tmp_path: Path) -> None:
    read(tmp_path, "875 400 300 0\n")
    (tmp_path / "rgb").mkdir()
    noise = np.random.default_rng(0).integers(0, 256, (400, 500, 3), np.uint8)
    data = heic_of(Pillow.fromarray(noise), quality=-1)
    (tmp_path / "rgb" / "a.heic").write_bytes(data)
    assert len(data) > 1 << 18  # its header alone is not enough
    cameras = load(tmp_path, Cameras)
    assert cameras.notes == ()
    assert {(camera.width, camera.height) for camera in cameras.cameras} == {(500, 400)}
