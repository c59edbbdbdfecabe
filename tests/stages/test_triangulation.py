"""Points by the pixels of photographs that show them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nerfbake import Camera
from nerfbake.errors import InvalidScene
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import look_at
from nerfbake.scene.lens import Lens, LensModel, all_round
from nerfbake.stages.triangulation import Sighting, triangulate

POINT = np.array([0.3, -0.2, 0.1])
LENSES: dict[LensModel, Lens] = {
    "polynomial": Lens("polynomial", (-0.2, 0.05), (0.002, -0.003), skew=0.01),
    "fisheye": Lens("fisheye", (0.03, -0.01)),
}


def camera(azimuth: float, *, lens: Lens | None = None, distance: float = 3.0, name: str = "a") -> Camera:
    pose = look_at(np.zeros(3), azimuth, 0.4, distance)
    return Camera(400, 300, (350.0, 360.0), pose, name, centre=(190.0, 155.0), lens=lens)


def seen(camera: Camera, point: Floats) -> Sighting:
    """Where a camera sees a point: the formulas of OpenCV's pinhole and fisheye cameras, written out once more."""
    x, y, z = camera.pose[:3, :3].T @ (point - camera.pose[:3, 3]) * (1, -1, -1)
    a, b = x / z, y / z
    lens = camera.lens
    if lens is not None and lens.model == "fisheye":
        r = np.hypot(a, b)
        theta = np.arctan(r)
        bent = theta * (1 + lens.k[0] * theta**2 + lens.k[1] * theta**4)
        a, b = a * bent / r, b * bent / r
    elif lens is not None:
        s, (p1, p2) = a * a + b * b, lens.p
        radial = 1 + lens.k[0] * s + lens.k[1] * s * s
        a, b = (
            a * radial + 2 * p1 * a * b + p2 * (s + 2 * a * a),
            b * radial + p1 * (s + 2 * b * b) + 2 * p2 * a * b,
        )
        a += lens.skew * b
    return Sighting(camera, 350 * a + 190, 360 * b + 155)


@pytest.mark.parametrize("lens", [None, *LENSES])
def test_the_point_is_where_it_was_projected_from(lens: LensModel | None) -> None:
    lenses = LENSES[lens] if lens else None
    for azimuths in ((0.0, 0.5), (0.0, 0.5, 1.1)):
        found = triangulate([seen(camera(azimuth, lens=lenses), POINT) for azimuth in azimuths])
        assert found.position == pytest.approx(POINT, abs=1e-9)
        assert found.miss < 1e-6


def test_a_panorama_shows_a_point_behind_its_axis() -> None:
    focal, centre, lens = all_round(512, 256)
    eyes = np.array([[0.0, 0, 0], [1.0, 0, 0]])
    point = np.array([0.5, 0.2, 2.0])  # the axes are -z
    sightings = []
    for eye in eyes:
        pose = np.eye(4)
        pose[:3, 3] = eye
        x, y, z = point - eye
        longitude, latitude = np.arctan2(x, -z), np.arcsin(-y / np.sqrt(x * x + y * y + z * z))
        shown = Camera(512, 256, focal, pose, "a", centre, lens)
        sightings.append(Sighting(shown, (longitude / (2 * np.pi) + 0.5) * 512, (latitude / np.pi + 0.5) * 256))
    assert triangulate(sightings).position == pytest.approx(point, abs=1e-9)


def test_the_angle_is_that_at_the_point() -> None:
    first, second = camera(0.0), camera(0.5)
    a, b = (each.pose[:3, 3] - POINT for each in (first, second))
    angle = np.degrees(np.arccos(a @ b / np.linalg.norm(a) / np.linalg.norm(b)))
    assert triangulate([seen(first, POINT), seen(second, POINT)]).angle == pytest.approx(angle)


@settings(max_examples=10)
@given(st.floats(-1.5, 1.5), st.floats(-1.5, 1.5), st.sampled_from([None, *LENSES]))
def test_the_miss_is_in_pixels(right: float, down: float, lens: LensModel | None) -> None:
    """Two near cameras agree, so that the point hardly moves: the far one misses it by what was added."""
    lenses = LENSES[lens] if lens else None
    near = [replace(camera(0.0, lens=lenses), pose=look_at(POINT + 0.01, azimuth, 0.4, 0.1)) for azimuth in (0.0, 1.0)]
    far = seen(camera(0.7, lens=lenses), POINT)
    moved = far._replace(x=far.x + right, y=far.y + down)
    assert triangulate([*(seen(each, POINT) for each in near), moved]).miss == pytest.approx(
        np.hypot(right, down), abs=0.05
    )


def test_rays_that_miss_each_other_are_refused() -> None:
    first, second = seen(camera(0.0), POINT), seen(camera(0.5, name="b"), POINT)
    with pytest.raises(
        InvalidScene, match=r"not the same point: their rays miss each other by \d+\.?\d* pixels in [ab]"
    ):
        triangulate([first, second._replace(y=second.y + 12)])
    large = [each._replace(camera=replace(each.camera, width=4000, height=3000)) for each in (first, second)]
    assert 4 < triangulate([large[0], large[1]._replace(y=second.y + 12)]).miss < 12


def test_rays_that_are_nearly_parallel_are_refused() -> None:
    with pytest.raises(InvalidScene, match=r"rays that are 1\.\d degrees apart; allowed: 1\.5 or more"):
        triangulate([seen(camera(azimuth), POINT) for azimuth in (0.0, 0.02)])


def test_rays_that_meet_behind_a_camera_are_refused() -> None:
    left, right = Camera(80, 60, 100.0, np.eye(4), "a"), Camera(80, 60, 100.0, np.eye(4), "b")
    right.pose[0, 3] = 1.0
    with pytest.raises(InvalidScene, match="meet behind a"):
        triangulate([Sighting(left, 30, 30), Sighting(right, 50, 30)])
    same = replace(left, name="b")
    with pytest.raises(InvalidScene, match="meet behind"):
        triangulate([Sighting(left, 30, 30), Sighting(same, 50, 30)])


def test_a_pixel_without_a_direction_is_refused() -> None:
    blind = camera(0.0, lens=Lens("polynomial", (-1.0,)))
    with pytest.raises(InvalidScene, match="shows nothing at pixel 399, 1"):
        triangulate([Sighting(blind, 399, 1), seen(camera(0.5), POINT)])
