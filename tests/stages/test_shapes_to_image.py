"""The sample room: points whose pixels and depths can be computed by hand, then laws for every pixel."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, memory_limit, orbit_room, render_room
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.scene.camera import look_from
from nerfbake.stages.shapes_to_image import DISTANCE, FOCUS, ROOM, _hash

Array = npt.NDArray[np.float64]
DOWN = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1]])  # right, up and back of a camera that looks down
AT_WALL = np.array([[0.0, 0, 1], [1, 0, 0], [0, 1, 0]])  # that looks along -x: right is y, up is z, back is x


def camera(axes: Array, place: list[float], edge: int = 5) -> Camera:
    """edge x edge pixels, whose focal length is the number of pixels."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, place
    return Camera(edge, edge, float(edge), pose)


def test_a_wall_is_where_it_is_by_hand() -> None:
    depth = render_room(camera(AT_WALL, [0.4, 0.0, 2.1])).depth
    # The wall x = -2.6 is 3.0 away. Pixel (2, 4) is two of five pixels right of the middle: 0.4 for each unit ahead.
    assert_allclose(depth[2, [0, 2, 4]], [3 * 1.16**0.5, 3, 3 * 1.16**0.5], rtol=1e-6)
    assert_allclose(depth[3, 1], 3 * (1 + 0.2**2 + 0.2**2) ** 0.5, rtol=1e-6)
    # Upwards, the ceiling at 2.5 is met before the wall: 0.4 higher after 1.0 ahead.
    assert_allclose(depth[0, 2], 1.16**0.5, rtol=1e-6)


@pytest.mark.parametrize(
    ("x", "y", "depth"),
    [
        (0.4, 0.3, 2.0 - 0.74),  # the table
        (0.13, 0.02, 2.0 - 0.9 - 0.16),  # the top of a ball on it
        (0.3, 0.02, None),  # beside the ball's rim: the table, 0.17 from the ball's centre of radius 0.16
        (-0.2, 0.1, 2.0 - 1.02),  # the parcel
        (-1.0, 1.0, 2.0),  # the floor
    ],
)
def test_things_have_the_height_that_they_have_by_hand(x: float, y: float, depth: float | None) -> None:
    found = render_room(camera(DOWN, [x, y, 2.0], edge=1)).depth[0, 0]
    assert_allclose(found, 2.0 - 0.74 if depth is None else depth, rtol=1e-6)


def test_a_ball_is_round() -> None:
    # 0.08 beside the middle of the ball of radius 0.16, the surface is sqrt(0.16^2 - 0.08^2) above the centre.
    found = render_room(camera(DOWN, [0.13, 0.1, 2.0], edge=1)).depth[0, 0]
    assert_allclose(found, 2.0 - 0.9 - (0.16**2 - 0.08**2) ** 0.5, rtol=1e-6)


def test_a_surface_looks_the_same_from_everywhere() -> None:
    first, *others = orbit_room(frames=6, width=24, height=24).cameras
    origin, directions = first.rays()
    image = render_room(first)
    points = origin + image.depth.reshape(-1, 1) * directions
    same = 0
    for other in others:
        for number in range(0, len(points), 7):
            away = other.pose[:3, 3] - points[number]
            distance = float(np.linalg.norm(away))
            seen = render_room(Camera(1, 1, 1.0, look_from(points[number], away / distance, distance)))
            assert seen.depth[0, 0] < distance + 1e-5
            if seen.depth[0, 0] > distance - 1e-5:  # nothing is in front of it
                assert_allclose(seen.colour[0, 0], image.colour.reshape(-1, 3)[number], atol=1e-4)
                same += 1
    assert same > 100


def test_a_pixel_is_the_mean_of_its_rays() -> None:
    (view,) = orbit_room(frames=1, width=12, height=8).cameras
    whole = slice(0, 12), slice(0, 8)
    fine = render_room(view.part(*whole, finer=2)).colour.reshape(8, 2, 12, 2, 3).mean(axis=(1, 3))
    assert_allclose(render_room(view, samples=2).colour, fine, atol=1e-6)


def test_colours_are_textured_and_within_the_range_of_a_picture() -> None:
    for seed in range(4):
        colour = render_room(orbit_room(frames=1, width=64, height=48).cameras[0], seed=seed).colour
        assert 0.05 < colour.min() < colour.max() < 1
        assert colour.std() > 0.1


def test_the_hash_is_that_of_murmurhash() -> None:
    # MurmurHash3_x86_32 of no bytes is its finalizer of the seed; these are its published test values.
    found = _hash(np.array([0, 1, 0xFFFFFFFF], np.uint32)) * 2**32
    assert [int(value) for value in found] == [0, 0x514E28B7, 0x81F16F39]


def test_the_seed_selects_the_textures_and_nothing_else() -> None:
    (view,) = orbit_room(frames=1, width=32, height=24).cameras
    first, again, other = render_room(view, seed=1), render_room(view, seed=1), render_room(view, seed=2)
    assert_array_equal(first.colour, again.colour)
    assert_array_equal(first.depth, other.depth)
    assert np.abs(first.colour - other.colour).mean() > 0.05


@pytest.mark.parametrize("frames", [1, 2, 5, 24, 200])
def test_cameras_walk_around_the_table_and_back(frames: int) -> None:
    cameras = orbit_room(frames=frames, width=40, height=30).cameras
    places = np.array([camera.pose[:3, 3] for camera in cameras])
    assert len(places) == frames
    assert ((ROOM[0] < places) & (places < ROOM[1])).all()
    assert_allclose(np.linalg.norm(places - FOCUS, axis=1), DISTANCE)
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert (steps > 0.01).all()
    assert (steps < 0.4).all()
    for camera in cameras:
        middle = camera.pose[:3, 3] - DISTANCE * camera.pose[:3, 2]
        assert_allclose(middle, FOCUS, atol=1e-12)


def test_a_place_outside_the_room_and_a_small_memory_are_refused() -> None:
    with pytest.raises(InvalidScene, match=r"is at 0, 3, 1; allowed: between -2.6, -2.3, 0 and 2.6, 2.3, 2.5"):
        render_room(camera(DOWN, [0, 3, 1]))
    with pytest.raises(InvalidScene, match="frames are 0; allowed: 1 to 10,000"):
        orbit_room(frames=0, width=8, height=8)
    with pytest.raises(MemoryLimit), memory_limit(1_000_000):
        render_room(orbit_room(frames=1, width=400, height=400).cameras[0])
