"""Which cameras show the same places."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake import Camera
from nerfbake.kernels.arrays import Floats
from nerfbake.stages.overlap import neighbours


def looking_down(x: float, *, turn: Floats | None = None) -> Camera:
    """A camera above (x, 0, 0) that shows a square of 2x2 there, at the distance 2."""
    pose = np.eye(4)
    pose[:3, 3] = x, 0, 2
    if turn is not None:
        pose[:3, :3] = turn
    return Camera(8, 8, 8.0, pose, f"{x:g}")


@pytest.mark.parametrize(
    ("places", "expected"),
    [
        ((0.0, 0.0, 0.0), 1.0),
        ((0.0, 0.0), 0.0),
        ((0.0, 1.1, 1.1), 3 / 7),
        ((0.0, 1.1, -1.1), 0.0),
        ((0.0, 9.0, 9.0), 0.0),
    ],
)
def test_the_share_of_places_that_two_others_show(places: tuple[float, ...], expected: float) -> None:
    # Of seven places along an edge of 2, the three at 0.29, 0.57 and 0.86 are within 1 of 1.1.
    cameras = tuple(map(looking_down, places))
    assert neighbours(cameras, 0, 2.0)[1] == pytest.approx(expected)


def test_a_camera_that_shows_another_place_is_no_neighbour() -> None:
    cameras = tuple(map(looking_down, (0.0, 0.3, 9.0)))
    assert neighbours(cameras, 0, 2.0)[0] == [1]
    assert neighbours(cameras, 2, 2.0)[0] == []


def test_places_that_others_show_from_behind_are_not_shared() -> None:
    behind = looking_down(0.0, turn=np.diag([1.0, -1, -1]))
    below = np.eye(4)
    below[:3, :3], below[:3, 3] = behind.pose[:3, :3], (0, 0, -2)
    others = tuple(Camera(8, 8, 8.0, below, name) for name in "ab")
    assert neighbours((looking_down(0.0), *others), 0, 2.0)[1] == 0
