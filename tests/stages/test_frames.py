"""Frames in metres: of cameras with positions on Earth, and of the ground."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfbake import Camera, Cameras
from nerfbake.errors import InvalidScene
from nerfbake.kernels.maths.affine import transform_points
from nerfbake.scene.camera import look_at
from nerfbake.scene.sparse_points import SparsePoints
from nerfbake.scene.world import EarthPlace, Frame
from nerfbake.stages.frames import (
    frame_of_ground,
    frame_to_positions,
    local_positions,
    lowered,
    vertical_of,
)

Array = npt.NDArray[np.float64]


def turned(random: np.random.Generator) -> Array:
    turn, _ = np.linalg.qr(random.normal(size=(3, 3)))
    return np.asarray(turn * np.sign(np.linalg.det(turn)))


def test_local_positions_are_metres_east_north_and_up() -> None:
    # A minute of latitude at 45 degrees is 1852.2 m, of longitude 1314.2 m (WGS 84).
    places = [
        EarthPlace(45, 9, 100),
        EarthPlace(45 + 1 / 60, 9, 100),
        EarthPlace(45, 9 + 1 / 60, 100),
        EarthPlace(45, 9, 150),
    ]
    positions, middle = local_positions([*places, EarthPlace(45, 9, 100)])
    assert middle == (45, 9, 100)
    assert positions[0] == pytest.approx([0, 0, 0], abs=1e-8)
    assert positions[1] == pytest.approx([0, 1852.2, -0.27], abs=0.1)
    assert positions[2] == pytest.approx([1314.2, 0.14, -0.14], abs=0.1)
    assert positions[3] == pytest.approx([0, 0, 50], abs=1e-8)


@settings(max_examples=10)
@given(st.integers(0, 2**32 - 1), st.floats(1e-3, 1e3))
def test_a_similarity_is_found_among_wrong_positions(seed: int, scale: float) -> None:
    random = np.random.default_rng(seed)
    frame = Frame(scale, turned(random), random.normal(size=3) * 100).matrix
    eyes = random.normal(size=(16, 3))
    positions = transform_points(eyes, frame)
    positions[:5] += scale * random.normal(size=(5, 3)) * 20
    fitted = frame_to_positions(eyes, positions)
    assert fitted.turned
    assert fitted.used >= 11
    assert np.abs(fitted.frame.matrix - frame).max() < 1e-6 * scale + 1e-9 * np.abs(frame).max()


def test_cameras_on_a_line_have_a_scale_alone() -> None:
    random = np.random.default_rng(0)
    eyes = np.linspace(0, 1, 12)[:, None] * np.array([1.0, 2, 2])
    positions = 7 * eyes @ turned(random).T + random.normal(size=(12, 3)) * 0.05
    fitted = frame_to_positions(eyes, positions)
    assert not fitted.turned
    assert np.array_equal(fitted.frame.turn, np.eye(3))
    assert fitted.frame.scale == pytest.approx(7, rel=0.02)


@pytest.mark.parametrize("eyes", [np.zeros((8, 3)), np.zeros((2, 3))])
def test_positions_that_determine_nothing_are_refused(eyes: Array) -> None:
    with pytest.raises(InvalidScene, match="positions"):
        frame_to_positions(eyes, np.ones_like(eyes))


def scene(turn: Array, *, outliers: int = 20) -> Cameras:
    """A ground at z = 2 with a wall beside it and a table above it, and cameras that are held level; then turned."""
    random = np.random.default_rng(3)
    flat = random.uniform(-3, 3, (400, 2))
    ground = np.column_stack([flat, np.full(400, 2.0)])
    wall = np.column_stack([np.full(300, 3.0), random.uniform(-3, 3, 300), random.uniform(2, 5, 300)])
    table = np.column_stack([random.uniform(-1, 1, (500, 2)), np.full(500, 3.0)])
    strays = random.uniform(-4, 0, (outliers, 3))
    points = np.concatenate([ground, wall, table, strays])
    poses = [look_at(np.array([0, 0, 2.5]), azimuth, 0.5, 4.0) for azimuth in np.linspace(0, 5, 9)]
    moved = []
    for i, pose in enumerate(poses):
        pose = pose.copy()
        pose[:3] = turn @ pose[:3]
        moved.append(Camera(8, 6, 9.0, pose, f"{i}"))
    return Cameras(tuple(moved), points=SparsePoints(points @ turn.T))


@pytest.mark.parametrize("seed", range(4))
def test_the_ground_is_the_lowest_plane_and_not_a_wall_or_a_table(seed: int) -> None:
    turn = turned(np.random.default_rng(seed))
    cameras = scene(turn)
    up = vertical_of(cameras)
    assert up == pytest.approx(turn[:, 2], abs=1e-9)
    ground = frame_of_ground(cameras, up)
    assert ground.share == pytest.approx(400 / 1220, abs=0.05)
    assert ground.height == pytest.approx(2, abs=0.02)
    placed = transform_points(cameras.points.positions, ground.frame.matrix)  # type: ignore[union-attr]
    assert np.abs(placed[:400, 2]).max() < 0.03
    assert placed[700:1200, 2] == pytest.approx(np.ones(500), abs=0.03)


def test_a_height_keeps_the_vertical() -> None:
    origin = np.array([100.0, 200.0, 300.0])
    frame = Frame(shift=-origin).then(lowered(-298.0, origin))
    assert transform_points(np.array([1.0, 2.0, 2.0]), frame.matrix) == pytest.approx([1, 2, 0])


def test_no_ground_is_refused() -> None:
    cameras = scene(np.eye(3), outliers=400)
    with pytest.raises(InvalidScene, match="the ground was not found"):
        frame_of_ground(cameras, np.array([0.0, 0.0, 1.0]))
    alike = Cameras(cameras.cameras[:1] * 5)
    with pytest.raises(InvalidScene, match="do not tell which way is up"):
        vertical_of(alike)
