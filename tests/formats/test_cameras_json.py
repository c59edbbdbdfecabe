from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.formats import cameras_json
from nerfbake.scene.camera import Cameras


def capture(**fields: Any) -> dict[str, Any]:
    frames = [{"file_path": "./train/r_7", "transform_matrix": np.eye(4).tolist()}]
    return {"camera_angle_x": 0.7, "frames": frames} | fields


def read(fields: Any) -> Cameras:
    return cameras_json.decode(memoryview(json.dumps(fields).encode()))


def test_a_capture_by_hand() -> None:
    (camera,) = read(capture()).cameras
    assert (camera.width, camera.height, camera.name) == (800, 800, "r_7")
    assert_allclose(camera.fx, 400 / np.tan(0.35))
    (camera,) = read(capture(w=640, h=480, fl_x=500)).cameras
    assert (camera.width, camera.height, camera.fx) == (640, 480, 500)


def test_what_is_written_is_read() -> None:
    cameras = read(capture(w=640, h=480, fl_x=500))
    again = cameras_json.decode(memoryview(b"".join(cameras_json.encode(cameras))))
    assert_allclose(again.cameras[0].pose, cameras.cameras[0].pose)
    assert again.cameras[0].fx == 500


def test_the_middle_of_the_middle_pixel_looks_ahead() -> None:
    (camera,) = read(capture(w=5, h=3)).cameras
    place, directions = camera.rays()
    assert_allclose(place, 0)
    assert_allclose(directions[7], [0, 0, -1], atol=1e-12)
    assert directions[0][0] < 0 < directions[0][1]  # the first pixel: to the left, and up


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ([], "holds a list"),
        (capture(frames=[]), "frames are 0; allowed: 1 to 100,000"),
        (capture(frames=[{}]), r"frames\[0\].transform_matrix has shape"),
        (capture(frames=[{"transform_matrix": np.diag([1, 1, 0, 1]).tolist()}]), "singular"),
        (capture(frames=[{"transform_matrix": [[1, 2], [3]]}]), "no table of numbers"),
        (capture(frames=[3]), "transform_matrix"),
        (capture(camera_angle_x=0), "camera_angle_x is 0"),
        (capture(camera_angle_x=4), "camera_angle_x is 4"),
        (capture(camera_angle_x="wide"), "camera_angle_x is wide"),
        (capture(w=-3, h=3), "w is -3"),
        (capture(w=1e8, h=1), "w is 100000000.0; allowed: a number from 1 to 16384"),
        (capture(fl_x=float("nan")), "cannot be parsed"),
    ],
)
def test_what_is_no_capture_is_refused(fields: Any, message: str) -> None:
    with pytest.raises((InvalidFile, InvalidScene), match=message):
        read(fields)


def test_what_is_no_json_is_refused() -> None:
    for data in (b"{", b"\xff", b"[" * 100_000):
        with pytest.raises(InvalidFile, match="cannot be parsed"):
            cameras_json.decode(memoryview(data))
