"""Vertices moved to where pictures show them, from a ball of the wrong size."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import Cameras, Mesh, Meshes, Views, move_vertices, render_meshes
from nerfbake.errors import InvalidScene
from nerfbake.kernels.surface.normals import face_normals
from nerfbake.scene.camera import Camera
from nerfbake.scene.lens import Lens
from tests.support.meshes import camera, sphere

BALL = sphere(16, 32)


def around(size: int = 96) -> tuple[Camera, ...]:
    return tuple(
        camera(size, size, 4.0, azimuth, elevation)
        for elevation in (-1.2, -0.4, 0.4, 1.2)
        for azimuth in np.arange(6) + elevation
    )


@cache
def ball_views() -> Views:
    return seen(BALL, around())


def seen(mesh: Mesh, cameras: tuple[Camera, ...]) -> Views:
    meshes = Meshes((mesh,))
    pictures = [render_meshes(meshes, view, background=None, samples=3).pixels for view in cameras]
    return Views(Cameras(cameras), tuple(pictures), (1.0, 1.0, 1.0), True)


def radii(mesh: Mesh) -> npt.NDArray[np.float64]:
    return np.asarray(np.linalg.norm(mesh.positions, axis=1))


@pytest.mark.parametrize("scale", [0.95, 1.05])
def test_a_ball_of_the_wrong_size_becomes_that_of_the_pictures(scale: float) -> None:
    wrong = replace(BALL, positions=BALL.positions * np.float32(scale))
    moved = move_vertices(wrong, ball_views(), rounds=3)
    assert np.abs(radii(moved) - 1).mean() < 0.2 * abs(scale - 1)
    np.testing.assert_array_equal(moved.faces, wrong.faces)


def test_a_ball_of_the_right_size_stays() -> None:
    moved = move_vertices(BALL, ball_views())
    assert np.abs(radii(moved) - 1).max() < 0.015  # half a pixel


def test_rims_are_found_through_a_bent_lens() -> None:
    lens = Lens("polynomial", (-0.15, 0.02))
    cameras = tuple(replace(view, lens=lens) for view in around())
    wrong = replace(BALL, positions=BALL.positions * np.float32(0.95))
    moved = move_vertices(wrong, seen(BALL, cameras), rounds=3)
    assert np.abs(radii(moved) - 1).mean() < 0.01


def test_no_face_turns_over() -> None:
    random = np.random.default_rng(0)
    rough = replace(
        BALL, positions=BALL.positions * random.uniform(0.9, 1.1, (len(BALL.positions), 1)).astype(np.float32)
    )
    moved = move_vertices(rough, ball_views(), rounds=1)
    before, after = (face_normals(mesh.positions.astype(np.float64), mesh.faces) for mesh in (rough, moved))
    cosine = (before * after).sum(axis=1) / np.linalg.norm(before, axis=1) / np.linalg.norm(after, axis=1)
    assert cosine.min() > 0.49
    assert np.abs(radii(moved) - radii(rough)).mean() > 0.005


def test_vertices_at_one_place_stay_together() -> None:
    # Every triangle has its own three vertices, as after a cut of the texture everywhere.
    apart = Mesh(
        BALL.positions[BALL.faces].reshape(-1, 3) * np.float32(0.95),
        None,
        np.arange(3 * len(BALL.faces), dtype=np.uint32).reshape(-1, 3),
    )
    whole = replace(BALL, positions=BALL.positions * np.float32(0.95))
    views = ball_views()
    moved, expected = move_vertices(apart, views), move_vertices(whole, views)
    np.testing.assert_array_equal(moved.positions.reshape(-1, 3, 3), expected.positions[expected.faces])


def test_pictures_of_nothing_of_the_mesh_are_refused() -> None:
    away = replace(BALL, positions=BALL.positions + np.array([0, 0, 100], np.float32))
    with pytest.raises(InvalidScene, match="show nothing that can be compared with the mesh"):
        move_vertices(away, ball_views())


def striped(scale: float = 1.0) -> Mesh:
    """A ball with wavy stripes along both angles, as its texture."""
    ball, (v, u) = sphere(24, 48), (np.mgrid[0:64, 0:128] + 0.5)
    polar, around = np.pi * v / 64, 2 * np.pi * u / 128
    waves = [np.sin(8 * polar), np.cos(9 * around) * np.sin(polar), np.sin(6 * polar + 5 * around) * np.sin(polar)]
    texture = np.rint(127.5 + 100 * np.stack(waves, axis=-1)).astype(np.uint8)
    # Every corner has its own texture coordinates, so that the seam and the poles need no care.
    corners = ball.positions[ball.faces].astype(np.float64)
    turn = np.arctan2(corners[..., 1], corners[..., 0]) / (2 * np.pi)
    middle = corners.mean(axis=1)
    centre = np.arctan2(middle[:, 1], middle[:, 0])[:, None] / (2 * np.pi)
    turn = np.where(np.abs(corners[..., 2]) > 0.999, centre, turn - np.rint(turn - centre))
    down = np.arccos(np.clip(corners[..., 2], -1, 1)) / np.pi
    uvs = np.stack([turn, down], axis=-1).reshape(-1, 2).astype(np.float32)
    faces = np.arange(3 * len(ball.faces), dtype=np.uint32).reshape(-1, 3)
    return Mesh((corners.reshape(-1, 3) * scale).astype(np.float32), uvs, faces, texture=texture)


def test_threads_do_not_matter(monkeypatch: pytest.MonkeyPatch) -> None:
    views, found = seen(striped(), around(32)[::4]), []
    for threads in ("1", "3"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        found.append(move_vertices(striped(0.97), views).positions)
    np.testing.assert_array_equal(found[0], found[1])
    assert (found[0] != striped(0.97).positions).any()


def test_colours_alone_move_faces_to_where_the_texture_fits() -> None:
    # Pictures with scenery have no rims: alpha separates only what is used from what is not.
    views = replace(seen(striped(), around()), scenery=True)
    moved = move_vertices(striped(0.97), views, rounds=6)
    assert np.abs(radii(moved) - 1).mean() < 0.01
