"""What `nerfbake info` tells of cameras."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import Camera, Cameras, load, summarise_scene
from nerfbake.cli.main import run
from nerfbake.scene.camera import look_at
from nerfbake.scene.lens import Lens
from tests.support.captures import rig, write_colmap_binary


def around(elevation: float, *, turn: npt.NDArray[np.float64] | None = None) -> Cameras:
    poses = [look_at(np.zeros(3), angle, elevation, 4.0) for angle in np.linspace(0, 6, 12)]
    if turn is not None:
        for pose in poses:
            pose[:3, :3] = turn @ pose[:3, :3]
    return Cameras(tuple(Camera(8, 6, 10.0, pose, f"{i}") for i, pose in enumerate(poses)))


def test_what_is_told_by_hand() -> None:
    first, second, *_ = around(0.3).cameras
    first = replace(first, focal=(9.0, 8.5), centre=(4.5, 2.0), lens=Lens("polynomial", (0.1, 0, -0.2), (0, 0.01)))
    told = summarise_scene(Cameras((first, second, second), "COLMAP", "sparse/0/images.bin", ("a note",)))
    places = np.stack([first.pose[:3, 3], second.pose[:3, 3]])
    assert told == {
        "kind": "cameras",
        "dialect": "COLMAP",
        "read_from": "sparse/0/images.bin",
        "cameras": 3,
        "pictures": {"8x6": 3},
        "focal_x": [9.0, 10.0],
        "focal_y": [8.5, 10.0],
        "centre_x_off": [0.0, 0.5],
        "centre_y_off": [-1.0, 0.0],
        "lenses": {"polynomial (k1 0.1, k3 -0.2, p2 0.01)": 1, "pinhole": 2},
        "position_box": [places.min(axis=0).tolist(), places.max(axis=0).tolist()],
        "up": "z",
        "notes": ["a note"],
    }


def test_samples_are_told_where_there_are_several() -> None:
    assert "samples" not in summarise_scene(around(0.5))
    assert summarise_scene(replace(around(0.5), samples=2))["samples"] == 2


def test_up_is_told_only_where_cameras_agree() -> None:
    half_turn = np.diag([1.0, -1, -1])
    to_y = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert summarise_scene(around(0.5))["up"] == "z"
    assert summarise_scene(around(0.5, turn=half_turn))["up"] == "-z"
    assert summarise_scene(around(0.5, turn=to_y))["up"] == "y"
    assert summarise_scene(around(1.5))["up"] is None  # all look down
    both = Cameras((*around(0.5).cameras, *around(0.5, turn=half_turn).cameras))
    assert summarise_scene(both)["up"] is None


def test_info_and_check_take_captures(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    capture = str(write_colmap_binary(tmp_path, rig(odd=True)))
    assert run(["check", capture]) == 0
    assert capsys.readouterr().err == f"{capture}: ok\n"
    assert run(["info", capture, "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {
        key: told[key] for key in ("format", "dialect", "read_from", "cameras", "pictures", "focal_x", "focal_y")
    } == {
        **{"format": "colmap", "dialect": "COLMAP", "read_from": "sparse/0/images.bin", "cameras": 3},
        **{"pictures": {"14x10": 3}, "focal_x": [17.5, 17.5], "focal_y": [16.25, 16.25]},
    }
    assert run(["info", capture]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "pictures            14x10 3" in lines
    assert "lenses              pinhole 3" in lines
    assert "centre x off        [-0.875, -0.875]" in lines


@pytest.mark.data
def test_the_real_captures(data: Path) -> None:
    told = summarise_scene(load(data / "nerf_synthetic" / "chair", Cameras))
    assert (told["dialect"], told["read_from"], told["up"]) == ("NeRF-Synthetic", "transforms_test.json", "z")
    assert told["pictures"] == {"400x400": 25}
    assert told["notes"] is None
