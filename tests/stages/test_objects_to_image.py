"""The sample objects: thin, glossy, and the same from everywhere but for their gloss."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, memory_limit, orbit_object, render_object
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.scene.camera import look_from
from nerfbake.stages.objects_to_image import DISTANCE, FOCUS, OBJECTS


def above(x: float, y: float, edge: int = 1) -> Camera:
    """A camera 3 above the ground that looks down; a pixel is 0.003 wide there."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, 3
    return Camera(edge, edge, 1000.0, pose)


@pytest.mark.parametrize(
    ("name", "x", "y", "height"),
    [
        ("struts", 0.85, -0.85, 0.04),  # the plate on the ground
        ("struts", 0.95, 0.85, None),  # beside it
        ("struts", -0.45, -0.44, 0.832),  # the rim of the wheel, near its top
        ("bricks", -0.94, -0.94, 0.03),  # a stud on the ground, 0.02 from its edges
        ("bricks", -0.92, -0.92, 0.02),  # between four studs
        ("bricks", 0.94, 0.94, 0.02),  # the plate without studs
        ("bricks", 0.97, 0.94, None),
    ],
)
def test_things_have_the_height_that_they_have_by_hand(name: str, x: float, y: float, height: float | None) -> None:
    image = render_object(name, above(x, y))
    if height is None:
        assert image.alpha[0, 0] == image.depth[0, 0] == 0
    else:
        assert_allclose(image.depth[0, 0], 3 - height, atol=1e-3)


@pytest.mark.parametrize("name", OBJECTS)
def test_a_surface_is_where_it_is_from_everywhere(name: str) -> None:
    first, *others = orbit_object(frames=5, edge=20).cameras
    origin, directions = first.rays()
    depth = render_object(name, first).depth.reshape(-1, 1)
    points = (origin + depth * directions)[depth[:, 0] > 0]
    same = 0
    for other in others:
        for point in points[::3]:
            away = other.pose[:3, 3] - point
            distance = float(np.linalg.norm(away))
            seen = render_object(name, Camera(1, 1, 1.0, look_from(point, away / distance, distance)))
            assert 0 < seen.depth[0, 0] < distance + 1e-5
            same += seen.depth[0, 0] > distance - 1e-5
    assert same > 10


@pytest.mark.parametrize("name", OBJECTS)
def test_a_picture_shows_an_object_in_front_of_nothing(name: str) -> None:
    (view,) = orbit_object(frames=1, edge=64, seed=2).cameras
    image, again = render_object(name, view, samples=2), render_object(name, view, samples=2)
    assert_array_equal(image.colour, again.colour)
    assert image.background is None
    assert 0.05 < image.alpha.mean() < 0.7
    assert not image.alpha[[0, -1]].any()
    assert not image.alpha[:, [0, -1]].any()
    assert (image.colour <= image.alpha[..., None] + 1e-6).all()
    assert image.colour[image.alpha == 1].std() > 0.05


def test_cameras_are_on_the_upper_hemisphere() -> None:
    cameras = orbit_object(frames=50, edge=16, seed=1).cameras
    away = np.array([camera.pose[:3, 3] for camera in cameras]) - FOCUS
    assert_allclose(np.linalg.norm(away, axis=1), DISTANCE)
    assert (away[:, 2] > 0).all()
    assert away[:, 2].min() < 0.5 < 3.5 < away[:, 2].max()
    other = orbit_object(frames=50, edge=16, seed=2).cameras
    assert np.abs(cameras[0].pose - other[0].pose).max() > 0.01


def test_what_does_not_exist_and_a_small_memory_are_refused() -> None:
    (view,) = orbit_object(frames=1, edge=400).cameras
    with pytest.raises(InvalidScene, match="object is 'crane'; allowed: struts, bricks"):
        render_object("crane", view)
    with pytest.raises(InvalidScene, match="frames are 0; allowed: 1 to 10,000"):
        orbit_object(frames=0, edge=8)
    with pytest.raises(MemoryLimit), memory_limit(1_000_000):
        render_object("struts", view)
