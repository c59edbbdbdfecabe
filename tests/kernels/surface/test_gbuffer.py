"""Triangles seen through a pinhole, against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.errors import InvalidScene
from nerfbake.kernels.surface.gbuffer import NONE, GBuffer, gbuffer
from nerfbake.scene.camera import Camera
from nerfbake.scene.lens import Lens
from nerfbake.scene.mesh import Mesh, joined_meshes
from tests.support.meshes import camera, cube, mesh, sphere, square, straight_down


def see(view: Camera, *meshes: Mesh) -> GBuffer:
    positions, faces, _ = joined_meshes(meshes)
    rays = view.rays()[1].reshape(view.height, view.width, 3)
    return gbuffer(positions, faces, view.pose, rays)


def test_one_triangle_by_hand() -> None:
    # From 2 above, a focal length of 4 pixels puts one world unit on two pixels: centres at x = -1, -0.5, 0, 0.5, 1.
    seen = see(straight_down(), mesh([[-0.6, -0.6, 0], [0.6, -0.6, 0], [-0.6, 0.6, 0]], [[0, 1, 2]]))
    expected = [[NONE, 0, NONE, NONE, NONE], [NONE, 0, 0, NONE, NONE], [NONE, 0, 0, 0, NONE]]
    np.testing.assert_array_equal(seen.triangle, expected)
    assert seen.distance[1, 2] == pytest.approx(2)
    assert seen.distance[1, 1] == pytest.approx(np.hypot(2, 0.5))
    assert np.isinf(seen.distance[0, 0])
    np.testing.assert_allclose(seen.weights[1, 2], [0, 0.5, 0.5], atol=1e-7)
    np.testing.assert_allclose(seen.weights[2, 1], [10 / 12, 1 / 12, 1 / 12], atol=1e-7)


def test_a_planes_distance_is_along_the_ray() -> None:
    view = camera(elevation=1.0)
    seen = see(view, square(z=-0.25))
    place, rays = view.rays()
    down = rays[:, 2]
    expected = np.where(down < 0, (-0.25 - place[2]) / down, np.inf).reshape(seen.distance.shape)
    np.testing.assert_allclose(seen.distance, expected, rtol=1e-12)


def test_weights_point_to_where_the_ray_meets_the_triangle() -> None:
    view, ball = camera(), sphere()
    seen = see(view, ball)
    hit = seen.triangle != NONE
    corners = ball.positions[ball.faces[seen.triangle[hit]]].astype(np.float64)
    points = (seen.weights[hit][..., None] * corners).sum(axis=1)
    place, rays = view.rays()
    expected = place + rays.reshape(*hit.shape, 3)[hit] * seen.distance[hit][:, None]
    np.testing.assert_allclose(points, expected, atol=1e-6)
    np.testing.assert_allclose(seen.weights[hit].sum(axis=1), 1, atol=1e-6)


def test_a_cube_is_a_box() -> None:
    view = camera(width=64, height=64)
    place, rays = view.rays()
    with np.errstate(divide="ignore"):
        low, high = (-0.5 - place) / rays, (0.5 - place) / rays
    near, far = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    expected = np.where(near <= far, near, np.inf).reshape(64, 64)
    np.testing.assert_allclose(see(view, cube()).distance, expected, rtol=1e-9)


LENSES = {
    "barrel": Lens("polynomial", (-0.3, 0.06)),
    "pincushion": Lens("polynomial", (0.4,), (0.02, -0.01)),
    "fisheye": Lens("fisheye", (0.05,)),
}


@pytest.mark.parametrize("bent", LENSES)
def test_through_a_lens_a_cube_is_a_box(bent: str) -> None:
    # The cube in small pieces, so that many boxes have to be right, seen off the centre and with oblong pixels.
    base = camera(64, 48)
    view = replace(base, focal=(base.fx, 1.3 * base.fx), centre=(20.0, 30.0), lens=LENSES[bent])
    place, rays = view.rays()
    with np.errstate(divide="ignore"):
        low, high = (-0.5 - place) / rays, (0.5 - place) / rays
    near, far = np.minimum(low, high).max(axis=1), np.maximum(low, high).min(axis=1)
    expected = np.where(near <= far, near, np.inf).reshape(48, 64)
    assert 0.05 < np.isfinite(expected).mean() < 0.95
    whole = cube()
    a, b, c = (whole.positions[whole.faces[:, i]] for i in range(3))
    steps = [(i, j) for i in range(8) for j in range(8 - i)]

    def corner(i: int, j: int) -> npt.NDArray[np.float32]:
        return np.asarray(a + (b - a) * np.float32(i / 8) + (c - a) * np.float32(j / 8))

    pieces = [(corner(i, j), corner(i + 1, j), corner(i, j + 1)) for i, j in steps]
    pieces += [(corner(i + 1, j), corner(i + 1, j + 1), corner(i, j + 1)) for i, j in steps if i + j < 7]
    positions = np.concatenate([np.stack(piece, axis=1) for piece in pieces]).reshape(-1, 3)
    small = mesh(positions, np.arange(len(positions)).reshape(-1, 3))
    np.testing.assert_allclose(see(view, whole).distance, expected, rtol=1e-9)
    np.testing.assert_allclose(see(view, small).distance, expected, rtol=1e-6)


def test_a_lens_that_looks_to_its_side_sees_no_mesh() -> None:
    view = replace(camera(64, 48), focal=16.0, lens=Lens("fisheye"))
    with pytest.raises(InvalidScene, match="looks 90 degrees or more to a side; allowed: less"):
        see(view, cube())


@pytest.mark.parametrize("seed", range(3))
def test_no_ray_passes_between_the_triangles_of_a_closed_mesh(seed: int) -> None:
    random = np.random.default_rng(seed)
    view = camera(200, 200, 1.0 + 3 * random.random(), *random.uniform(0, 1.5, 2))
    place, rays = view.rays()
    # Rays that come nearer to the centre than the sphere's triangles lie to it meet it, inside or outside.
    ball = sphere(96, 192)
    nearest = np.linalg.norm(place - rays * (rays @ place)[:, None], axis=1).reshape(200, 200)
    hit = see(view, ball).triangle != NONE
    assert hit[nearest < 0.998].all()
    assert not hit[nearest > 1].any()


def test_no_ray_passes_through_an_edge_or_a_corner() -> None:
    # The middle pixel looks exactly at the vertex in the middle, its row and column along edges.
    fan = mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]], [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 1]])
    seen = see(straight_down(9, 9, 10.0, 5.0), fan)
    hit = seen.triangle != NONE
    assert hit[4, 2:7].all()
    assert hit[2:7, 4].all()
    assert seen.triangle[4, 4] == 0  # of equally near ones the first


def test_inside_a_closed_mesh_every_ray_meets_it() -> None:
    seen = see(camera(distance=0.2), cube())
    assert (seen.triangle != NONE).all()
    assert 0.3 < seen.distance.min() <= seen.distance.max() < 1.8


def test_what_is_behind_the_camera_is_not_seen() -> None:
    assert (see(straight_down(), square(z=2.5)).triangle == NONE).all()


def test_a_triangle_through_the_cameras_plane() -> None:
    # A floor below a camera that looks along it: it is seen below the horizon, and nowhere above.
    view = camera(distance=3.0, elevation=0.0)
    seen = see(view, square(z=-1.0, half=1000.0))
    _, rays = view.rays()
    down = rays[:, 2].reshape(seen.distance.shape)
    expected = np.divide(-1.0, down, out=np.full_like(down, np.inf), where=down < 0)
    np.testing.assert_allclose(seen.distance[expected < 900], expected[expected < 900], rtol=1e-9)
    assert (seen.triangle[down >= 0] == NONE).all()


def test_boxes_leave_nothing_out() -> None:
    # Large random triangles all around the camera, many of them through its plane, against a test of every pixel.
    random = np.random.default_rng(5)
    view = camera(24, 16, distance=0.5)
    for size in (0.3, 3.0):
        soup = mesh(random.normal(0, size, (60, 3)), np.arange(60).reshape(-1, 3))
        place, rays = view.rays()
        a, b, c = (soup.positions[soup.faces[:, i]].astype(np.float64) - place for i in range(3))
        weights = np.stack([rays @ np.cross(b, c).T, rays @ np.cross(c, a).T, rays @ np.cross(a, b).T])
        inside = (weights >= 0).all(axis=0) | (weights <= 0).all(axis=0)
        far = (a * np.cross(b, c)).sum(axis=1) / weights.sum(axis=0)
        expected = np.where(inside & (far > 0), far, np.inf).min(axis=1).reshape(16, 24)
        assert np.isfinite(expected).any()
        np.testing.assert_allclose(see(view, soup).distance, expected, rtol=1e-9)


def test_the_nearest_wins_whatever_the_order() -> None:
    near, far = square(z=1.0), square(z=0.0)
    view = straight_down()
    a, b = see(view, near, far), see(view, far, near)
    np.testing.assert_array_equal(a.distance, b.distance)
    assert a.triangle.max() < 2 <= b.triangle.min()


def test_threads_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    view = camera(100, 100)
    monkeypatch.setenv("NUMBA_NUM_THREADS", "1")
    alone = see(view, sphere(), cube(0.9))
    monkeypatch.setenv("NUMBA_NUM_THREADS", "3")
    for one, other in zip(alone, see(view, sphere(), cube(0.9)), strict=True):
        np.testing.assert_array_equal(one, other)


def test_triangles_without_an_area_are_not_seen() -> None:
    flat = mesh([[0, 0, 0], [1, 1, 0], [2, 2, 0], [0, 0, 1]], [[0, 1, 2], [0, 0, 1], [3, 3, 3]])
    seen = see(straight_down(65, 65, 60.0), flat)
    assert not np.isnan(seen.distance).any()
    assert np.isinf(see(straight_down(65, 65, 60.0), mesh(np.zeros((3, 3)), [[0, 1, 2]])).distance).all()


def test_a_pose_that_stretches_is_followed() -> None:
    view = straight_down()
    pose = view.pose.copy()
    pose[:3, :3] *= [[2.0, 3.0, 0.5]]
    stretched = replace(view, pose=pose)
    seen = see(stretched, square())
    place, rays = stretched.rays()
    np.testing.assert_allclose(seen.distance.reshape(-1), -place[2] / rays[:, 2], rtol=1e-12)
