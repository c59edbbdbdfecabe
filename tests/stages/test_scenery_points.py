"""What sparse points tell a fit of scenery: between which distances the pictures show something."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import Camera, Cameras, Views
from nerfbake.kernels.arrays import Bits, Points
from nerfbake.scene.sparse_points import SparsePoints
from nerfbake.stages._bricks import cell_places
from nerfbake.stages._scenery import start_scenery, wall_of
from nerfbake.stages._scenery_points import LEAST_POINTS, reach_of

HEIGHT, EDGE = 5.0, 5.0
BOX = np.array([[-4.0, -4, -4], [4, 4, 4]])


def above_ground(*, depth: float = 0.0, without: int | None = None) -> Cameras:
    """3 x 3 cameras at HEIGHT, 2.5 apart, that look down on points of the ground z = 0, or down to -depth.

    Each camera sees 5 x 5 units of the ground. without: a camera that has no observations.
    """
    places = 2.5 * (np.stack(np.meshgrid(*[np.arange(3.0)] * 2, indexing="ij"), -1).reshape(-1, 2) - 1)
    cameras = []
    for i, (x, y) in enumerate(places.tolist()):
        pose = np.eye(4)
        pose[:3, 3] = x, y, HEIGHT
        cameras.append(Camera(16, 16, 16.0, pose, str(i)))
    random = np.random.default_rng(0)
    ground = random.uniform(-EDGE, EDGE, (2000, 2))
    near = np.asarray((np.abs(ground[None] - places[:, None]) < HEIGHT / 2).all(axis=2))
    if without is not None:
        near[without] = False
    camera, point = np.nonzero(near)
    heights = -depth * random.uniform(size=len(ground))
    points = SparsePoints(np.column_stack([ground, heights]), camera, point, np.zeros((len(point), 2)))
    return Cameras(tuple(cameras), points=points)


def fog(cameras: Cameras) -> Points:
    """The centres of the first cells of a fit that are not part of the wall, in the inner cube."""
    pictures = (np.full((16, 16, 4), 255, np.uint8),) * len(cameras.cameras)
    views = Views(cameras, pictures, (1.0, 1.0, 1.0), False, scenery=True)
    cells = start_scenery(views, BOX, 32, 1).cells
    shell, corner = cell_places(cells.bricks)
    centre = cells.bricks.low[0] + (corner + 0.5) * cells.bricks.size[0]
    return np.asarray(centre[~wall_of(cells) & (shell == 0)])


def in_corner(centre: Points, sign: int) -> Bits:
    """The cells near the ground that only the first camera sees (sign -1), or only the last one (1)."""
    return np.asarray((sign * centre[:, :2] > 3.3).all(axis=1) & (np.abs(centre[:, 2]) < 1))


def test_pictures_of_equally_distant_points_have_a_reach() -> None:
    near, far = reach_of(above_ground(without=4))
    known = np.arange(9) != 4
    assert_array_equal(near > 0, known)
    assert_array_equal(np.isfinite(far), known)
    assert near[0] == pytest.approx(0.8 * HEIGHT, rel=0.02)
    assert 1.25 * HEIGHT < far[0] < 1.25 * 1.25 * HEIGHT  # the corners are 1.22 HEIGHT away


@pytest.mark.parametrize("cause", ["depth", "few", "none"])
def test_other_pictures_have_none(cause: str) -> None:
    cameras = above_ground(depth=10.0 if cause == "depth" else 0.0)
    points = cameras.points
    assert points is not None
    some = np.concatenate([np.flatnonzero(points.camera == i)[: LEAST_POINTS - 1] for i in range(9)])
    few = replace(points, camera=points.camera[some], point=points.point[some], pixel=points.pixel[some])
    cameras = replace(cameras, points={"depth": points, "few": few, "none": None}[cause])
    near, far = reach_of(cameras)
    assert not near.any()
    assert np.isinf(far).all()


def test_fog_starts_where_the_points_are_also_where_one_view_looks() -> None:
    centre, blind = fog(above_ground()), fog(replace(above_ground(), points=None))
    assert 0.2 * HEIGHT < centre[:, 2].max() < 0.35 * HEIGHT < 0.5 * HEIGHT < blind[:, 2].max()
    assert centre[:, 2].min() > -3.5 > blind[:, 2].min()
    assert in_corner(centre, -1).any()
    assert not in_corner(blind, -1).any()


def test_one_view_without_points_is_not_enough() -> None:
    centre = fog(above_ground(without=0))
    assert in_corner(centre, 1).any()
    assert not in_corner(centre, -1).any()
