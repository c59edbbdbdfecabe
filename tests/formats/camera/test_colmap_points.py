"""Sparse points of a COLMAP model: read from both kinds of files, and with a transforms.json beside it."""

from __future__ import annotations

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Cameras, load
from nerfbake.errors import InvalidFile

POINTS = {7: (1.0, 2.0, 3.0), 3: (-1.0, 0.5, 4.0), 9: (0.0, 0.0, 5.0)}
SHOWN = {2: [(1.5, 2.5, 9), (0.5, 0.5, -1)], 1: [(3.0, 1.0, 7), (2.0, 2.0, 3), (1.0, 1.0, 8)]}  # 8 does not exist


def write_text(folder: Path, points: str | None = None, places: str | None = None) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text("1 PINHOLE 4 3 5 5 2 1.5\n")
    lines = []
    for number, shown in SHOWN.items():
        line = " ".join(f"{x} {y} {point}" for x, y, point in shown) if places is None else places
        lines.append(f"{number} 1 0 0 0 {number} 0 0 1 {number}.png\n{line}\n")
    (folder / "images.txt").write_text("".join(lines))
    made = "# id x y z r g b error track\n" + "".join(
        f"{key} {x} {y} {z} 1 2 3 0.5 1 0 2 0\n" for key, (x, y, z) in POINTS.items()
    )
    (folder / "points3D.txt").write_text(made if points is None else points)
    return folder


def points_file(count: int = len(POINTS)) -> bytes:
    made = struct.pack("<Q", count)
    for key, position in POINTS.items():
        made += struct.pack("<Q3d3BdQ4I", key, *position, 1, 2, 3, 0.5, 2, 1, 0, 2, 0)
    return made


def write_binary(folder: Path, points: bytes) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(struct.pack("<QIiQQ4d", 1, 1, 1, 4, 3, 5, 5, 2, 1.5))
    made = struct.pack("<Q", len(SHOWN))
    for number, shown in SHOWN.items():
        made += struct.pack("<I7dI", number, 1, 0, 0, 0, number, 0, 0, 1) + f"{number}.png".encode() + b"\0"
        made += struct.pack("<Q", len(shown)) + b"".join(struct.pack("<2dq", *each) for each in shown)
    (folder / "images.bin").write_bytes(made)
    (folder / "points3D.bin").write_bytes(points)
    return folder


def require_points(cameras: Cameras) -> None:
    assert [camera.name for camera in cameras.cameras] == ["1", "2"]
    points = cameras.points
    assert points is not None
    assert_array_equal(points.positions, [POINTS[3], POINTS[7], POINTS[9]])
    assert_array_equal(points.camera, [0, 0, 1])
    assert_array_equal(points.point, [1, 0, 2])
    assert_array_equal(points.pixel, [[3, 1], [2, 2], [1.5, 2.5]])


def test_points_and_observations_are_read_from_both_kinds_of_files(tmp_path: Path) -> None:
    require_points(load(write_text(tmp_path / "text"), Cameras))
    require_points(load(write_binary(tmp_path / "binary", points_file()), Cameras))


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (points_file()[:-1], "ends after"),
        (points_file()[:-40], "ends after"),
        (points_file(1 << 60), "counts 1,152,921,504,606,846,976"),
        (b"", "has 0 bytes"),
        (points_file().replace(struct.pack("<d", 4.0), struct.pack("<d", float("nan"))), "not finite"),
        (points_file().replace(struct.pack("<Q", 9), struct.pack("<Q", 7)), "has 1 ids twice"),
    ],
)
def test_broken_binary_points_are_one_line(points: bytes, said: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match=said):
        load(write_binary(tmp_path, points), Cameras)


@pytest.mark.parametrize(
    ("points", "places", "said"),
    [
        ("1 2 3\n", None, "line 1 is 1 2 3; allowed: id x y z of a point"),
        ("1 2 3 nan\n", None, "not finite"),
        (None, "1 2 nan", "is not places of points"),
    ],
)
def test_broken_text_points_are_one_line(points: str | None, places: str | None, said: str, tmp_path: Path) -> None:
    with pytest.raises(InvalidFile, match=said):
        load(write_text(tmp_path, points, places), Cameras)


@pytest.mark.parametrize("turned", [True, False])
def test_transforms_take_the_points_of_the_model_beside_them(turned: bool, tmp_path: Path) -> None:
    write_text(tmp_path / "sparse/0")
    turn = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]) if turned else np.eye(3)
    frames = []
    for i, camera in enumerate(load(tmp_path / "sparse/0", Cameras).cameras):
        pose = camera.pose.copy()
        pose[:3, 3] += [0, 0, 5 * i]
        pose[:3] = turn @ pose[:3]
        frames.append({"file_path": f"images/{camera.name}.png", "transform_matrix": pose.tolist()})
    fields = {"w": 4, "h": 3, "fl_x": 5.0, "fl_y": 5.0, "frames": frames}
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    assert load(tmp_path, Cameras).points is None  # other poses than the model's
    frames[1]["transform_matrix"] = (np.array(frames[1]["transform_matrix"]) - 5 * np.outer(*_last(turn))).tolist()
    (tmp_path / "transforms.json").write_text(json.dumps(fields))
    points = load(tmp_path, Cameras).points
    assert points is not None
    assert_allclose(points.positions, np.array([POINTS[3], POINTS[7], POINTS[9]]) @ turn.T, atol=1e-12)
    assert_array_equal(points.camera, [0, 0, 1])
    (tmp_path / "sparse/0/points3D.txt").write_text("broken")
    assert load(tmp_path, Cameras).points is None


def _last(turn: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A shift along the third axis of the model, as a column and the row that selects the last column."""
    return np.append(turn[:, 2], 0), np.eye(4)[3]
