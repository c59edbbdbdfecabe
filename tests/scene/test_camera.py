"""Cameras: what they refuse, and that nothing changed for those that had one focal length."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake import Camera, Cameras
from nerfbake.errors import InvalidScene
from nerfbake.scene.camera import look_at
from nerfbake.scene.lens import Lens

POSE = look_at(np.array([0.3, -0.2, 0.1]), 0.7, 0.4, 3.0)


def old_rays(width: int, height: int, focal: float, pose: Any) -> Any:
    """As they were calculated when a camera had one focal length and its centre in the middle."""
    right, up, back = pose[:3, :3].T
    x = (np.arange(width) + 0.5 - width / 2) / focal
    y = -(np.arange(height) + 0.5 - height / 2) / focal
    directions = (x[:, None] * right - back) + (y[:, None] * up)[:, None]
    across, down, along = np.moveaxis(directions, -1, 0)
    directions /= np.sqrt(across * across + down * down + along * along)[..., None]
    return directions.reshape(-1, 3)


@pytest.mark.parametrize("size", [(31, 17), (20, 20), (1, 7)])
def test_a_simple_pinhole_has_the_same_rays_to_the_bit(size: tuple[int, int]) -> None:
    simple = Camera(*size, 33.3, POSE)
    spelled = Camera(*size, (33.3, 33.3), POSE, centre=(size[0] / 2, size[1] / 2), lens=Lens("polynomial", (0.0,)))
    for camera in (simple, spelled):
        assert camera.rays()[1].tobytes() == old_rays(*size, 33.3, POSE).tobytes()
        assert camera.resized(9, 8).rays()[1].tobytes() == old_rays(9, 8, 33.3 * 9 / size[0], POSE).tobytes()


def test_a_reduced_camera_looks_through_the_middle_of_its_blocks() -> None:
    camera = Camera(32, 21, (25.0, 24.0), POSE, centre=(13.0, 11.5))
    assert camera.reduced(1) is camera
    third = camera.reduced(3)
    assert (third.width, third.height) == (10, 7)
    # The middle pixel of a block, also beside the two columns that are cut off.
    middle = camera.rays()[1].reshape(21, 32, 3)[1::3, 1:30:3]
    assert_allclose(third.rays()[1].reshape(7, 10, 3), middle, atol=1e-12)


def test_a_resized_camera_looks_through_the_same_corners() -> None:
    lens = Lens("polynomial", (-0.1, 0.02), (0.001, 0.002))
    camera = Camera(30, 20, (25.0, 24.0), POSE, centre=(13.0, 11.5), lens=lens)
    half = camera.resized(15, 10)
    assert (half.fx, half.fy, half.cx, half.cy, half.lens) == (12.5, 12.0, 6.5, 5.75, lens)
    # A pixel of the half picture looks between four of the whole one.
    whole = camera.rays()[1].reshape(20, 30, 3)
    between = whole[::2, ::2] + whole[1::2, ::2] + whole[::2, 1::2] + whole[1::2, 1::2]
    between /= np.linalg.norm(between, axis=2, keepdims=True)
    assert_allclose(half.rays()[1].reshape(10, 15, 3), between, atol=2e-4)


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ({"width": 0}, "has 0x3 pixels"),
        ({"height": 16385}, "has 4x16385 pixels"),
        ({"focal": 0.0}, "has focal length 0"),
        ({"focal": (3.0, np.inf)}, "has focal length inf"),
        ({"focal": np.nan}, "has focal length nan"),
        ({"centre": (np.nan, 0.0)}, "has its centre at nan, 0"),
        ({"centre": (0.0, 1e12)}, "has its centre at 0, 1e"),
        ({"pose": np.eye(3)}, r"has a pose of shape \(3, 3\)"),
        ({"pose": np.diag([1, 1, np.nan, 1.0])}, "has a pose with NaN"),
        ({"pose": np.diag([1, 1, 0.0, 1])}, "has a singular pose"),
        ({"pose": np.diag([1, 1, 1, 2.0])}, "has a pose whose last row is"),
        ({"pose": np.diag([1e9, 1, 1, 1.0])}, "has a pose with an axis of 1e"),
        ({"pose": np.block([[np.eye(3), np.full((3, 1), 1e16)], [np.zeros((1, 3)), np.eye(1)]])}, "has a coordinate"),
    ],
)
def test_what_is_no_camera_is_refused(wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(InvalidScene, match=f"^camera r_1 {said}.*allowed"):
        replace(Camera(4, 3, 5.0, np.eye(4), "r_1"), **wrong)


@pytest.mark.parametrize(
    "turn", [np.diag([1.0, 1, -1]), np.diag([2.0, 2, 2]), np.array([[1, 0.1, 0], [0, 1, 0], [0, 0, 1]])]
)
def test_poses_that_are_no_rotation_are_told(turn: Any) -> None:
    pose = np.eye(4)
    pose[:3, :3] = turn
    cameras = Cameras((Camera(4, 3, 5.0, np.eye(4), "a"), Camera(4, 3, 5.0, pose, "b"), Camera(4, 3, 5.0, pose, "c")))
    (problem,) = cameras.problems()
    assert str(problem).startswith("camera b has a pose that is not a rotation")
    assert problem.times == 2
    assert cameras.structure_problems() == []


def posed(turn: Any, name: str = "a") -> Camera:
    pose = np.eye(4)
    pose[:3, :3] = turn
    pose[:3, 3] = 1, 2, 3
    return Camera(4, 3, 5.0, pose, name)


TURN = np.array([[0.6, -0.48, 0.64], [0.8, 0.36, -0.48], [0, 0.8, 0.6]])
NO_ROTATION = "has a pose that is not a rotation; allowed: right-handed axes of length 1, at right angles"


@pytest.mark.parametrize("scale", [1.3, 0.1, 0.999, 1e-5, 1e5])
def test_a_scale_is_divided_out_of_the_axes_and_the_position_stays(scale: float) -> None:
    camera = posed(TURN * scale)
    assert_allclose(camera.pose[:3, :3], TURN, rtol=0, atol=1e-15)
    assert camera.pose[:3, 3].tolist() == [1, 2, 3]
    assert camera.scale == pytest.approx(scale)
    cameras = Cameras((posed(TURN), replace(camera, name="b")))
    assert_allclose(cameras.axes[1], -TURN[:, 2], rtol=0, atol=1e-15)


def test_a_scale_is_a_note_and_what_is_wrong_with_axes_a_warning() -> None:
    assert Cameras((posed(TURN),)).pose_notes == ()
    assert Cameras((posed(TURN), posed(TURN * 0.5), posed(TURN * 2.5))).pose_notes == (
        "the axes of 2 of 3 poses are a rotation times 0.5 to 2.5, which is divided out",
    )
    cameras = Cameras((posed(TURN), posed(TURN * [1, 1, 0.5], "b"), posed(TURN * [1, -1, 1], "c")))
    assert cameras.pose_notes == (f"warning: camera b {NO_ROTATION} (and 1 more)",)
    mirrored = posed(-1.3 * TURN, "b")
    assert_allclose(mirrored.pose[:3, :3], -TURN, rtol=0, atol=1e-15)
    assert Cameras((mirrored,)).pose_notes == (
        "the axes of 1 of 1 pose are a rotation times 1.3, which is divided out",
        f"warning: camera b {NO_ROTATION}",
    )


@pytest.mark.parametrize("noise", [1e-4, 1e-7])
def test_rounding_of_axes_is_left_as_it_is(noise: float) -> None:
    turn = TURN * (1 + noise) + noise * np.array([[1, -1, 1], [1, 1, -1], [-1, 1, 1]])
    camera = posed(turn)
    assert camera.pose[:3, :3].tobytes() == turn.tobytes()
    assert (camera.scale, Cameras((camera,)).pose_notes, Cameras((camera,)).problems()) == (1, (), [])


def test_the_extremes_that_are_allowed_have_rays() -> None:
    far = np.eye(4)
    far[:3, 3] = 1e15
    far[:3, :3] *= 1e6
    for camera in (Camera(3, 2, 1e-6, far), Camera(3, 2, (1e9, 1e-6), far, centre=(1e9, -1e9))):
        _, directions = camera.rays()
        assert np.isfinite(directions).all()
        assert_allclose(np.linalg.norm(directions, axis=1), 1)


def test_the_point_that_cameras_look_at() -> None:
    def at(*place: float, looks: str) -> Camera:
        pose = np.eye(4)
        if looks == "-x":
            pose[:3, :3] = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
        pose[:3, 3] = place
        return Camera(4, 3, 5.0, pose)

    crossing = Cameras((at(1, 2, 9, looks="-z"), at(9, 2, 3, looks="-x")))
    assert_allclose(crossing.axes, [[0, 0, -1], [-1, 0, 0]])
    assert_allclose(crossing.looked_at(towards=np.zeros(3), pull=1e-9), [1, 2, 3], atol=1e-6)
    parallel = Cameras((at(0, 0, 9, looks="-z"), at(4, 0, 9, looks="-z")))
    assert_allclose(parallel.looked_at(towards=np.array([0.0, 0, 5]), pull=1e-9), [2, 0, 5], atol=1e-6)
