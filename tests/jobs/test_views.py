"""Cameras of a capture or of an orbit."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from nerfbake import N3Tree, build_field, load, orbit_cameras
from nerfbake.errors import InvalidFile, InvalidScene, MemoryLimit
from nerfbake.jobs.steps import SILENT
from nerfbake.jobs.views import read_cameras, views_of
from nerfbake.memory import memory_limit
from tests.jobs.listener import Listener
from tests.support.captures import rig, write_colmap_binary


@pytest.mark.usefixtures("folder")
def test_a_capture_or_an_orbit_in_any_size() -> None:
    field = build_field(load("a.npz", N3Tree))
    around = views_of(SILENT, field, None, name="a.npz", frames=4, edge=30)
    assert [(view.width, view.height) for view in around.cameras] == [(30, 30)] * 4
    np.testing.assert_array_equal(around.cameras[1].pose, orbit_cameras(field, frames=4).cameras[1].pose)
    for cameras in (None, "cameras.json"):
        resized = views_of(SILENT, field, cameras, name="a.npz", frames=3, edge=30, size=(10, 8))
        assert [(view.width, view.height) for view in resized.cameras] == [(10, 8)] * 3
    with pytest.raises(InvalidScene, match=r"^a.npz: frames are 0"):
        views_of(SILENT, field, None, name="a.npz", frames=0, edge=30)


def test_where_cameras_are_from_and_what_was_taken_for_granted_is_said(tmp_path: Path, listener: Listener) -> None:
    write_colmap_binary(tmp_path / "capture", rig(odd=True))
    read = read_cameras(listener, str(tmp_path / "capture"))
    assert listener.said == [f"{tmp_path}/capture: {read} from sparse/0/images.bin"]
    frame = {"file_path": "gone", "transform_matrix": np.eye(4).tolist()}
    (tmp_path / "t.json").write_text(json.dumps({"camera_angle_x": 1, "frames": [frame]}))
    read_cameras(listener, str(tmp_path / "t.json"))
    assert "no size and no picture for 1 of its cameras" in listener.said[1]


@pytest.mark.usefixtures("folder")
def test_cameras_count_in_the_allowance() -> None:
    Path("cameras.json").write_text(Path("cameras.json").read_text() + " " * 1_000_000)
    with memory_limit(1_000_000), pytest.raises(MemoryLimit, match=r"cameras.json: the file needs .*`memory_limit`"):
        read_cameras(SILENT, "cameras.json")
    with pytest.raises(InvalidFile, match=r"none\.json"):
        read_cameras(SILENT, "none.json")
