"""Surfaces of fields, with closed forms and trimesh as the oracles."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys

import numpy as np
import pytest
import trimesh

from nerfbake import (
    Camera,
    Cameras,
    Mesh,
    Meshes,
    RadianceField,
    build_field,
    build_surface,
    orbit_cameras,
    render_field,
    render_meshes,
    sample_n3tree,
    scatter_cameras,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.kernels.surface.triangles import turned_over
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import look_at
from tests.support.scenes import n3tree

EDGE = 32


def balls(*centres_and_radii: tuple[tuple[float, float, float], float], hollow: float = 0.0) -> RadianceField:
    """Dense balls, in cells of 32^3."""
    places = np.stack(np.meshgrid(*[np.arange(EDGE) + 0.5] * 3, indexing="ij"), axis=-1)
    data = np.zeros((1, EDGE, EDGE, EDGE, 4), np.float32)
    for centre, radius in centres_and_radii:
        away = np.sqrt(((places - centre) ** 2).sum(axis=-1))
        share = np.clip(radius - away + 0.5, 0, 1) * (away >= hollow)
        data[0, ..., 3] = np.maximum(data[0, ..., 3], 200 * share)
    return build_field(n3tree(N=EDGE, data=data, data_format="RGBA"))


def surface(field: RadianceField, **options: object) -> Mesh:
    return build_surface(field, scatter_cameras(field, frames=24, edge=64), **options)  # type: ignore[arg-type]


def solid(mesh: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(mesh.positions, mesh.faces, process=False)


def test_a_ball_is_a_closed_ball_with_the_fields_silhouettes() -> None:
    field = balls(((16, 16, 16), 9))
    mesh = surface(field)
    cells = mesh.positions @ field.place[:, :3].T + field.place[:, 3]
    # Half a cell more than the ball: its outermost cells are opaque, too.
    assert np.abs(np.linalg.norm(cells - 16, axis=1) - 9.5).max() < 0.8
    assert solid(mesh).is_volume
    for camera in orbit_cameras(field, frames=3, width=64, height=64).cameras:
        covered = render_meshes(Meshes((mesh,)), camera, samples=2).alpha
        expected = render_field(field, camera, samples=2).alpha
        assert np.abs(covered - expected).sum() < 0.04 * expected.sum()


def test_a_field_without_a_surface_is_refused() -> None:
    thin = n3tree(data=np.full((1, 2, 2, 2, 4), 0.01, np.float32), data_format="RGBA")
    field = build_field(thin)
    with pytest.raises(InvalidScene, match="has no surface that a camera sees"):
        surface(field)


def test_a_lid_over_space_that_no_camera_saw_is_removed() -> None:
    # A tube without ends, seen from the sides alone: nothing tells that it is hollow.
    places = np.stack(np.meshgrid(*[np.arange(EDGE) + 0.5] * 3, indexing="ij"), axis=-1)
    away = np.linalg.norm(places[..., :2] - 16, axis=-1)
    data = np.zeros((1, EDGE, EDGE, EDGE, 4), np.float32)
    data[0, ..., 3] = 300 * ((away < 12) & (away > 10.5) & (abs(places[..., 2] - 16) < 8))
    field = build_field(n3tree(N=EDGE, data=data, data_format="RGBA"))
    centre = field.world(field.box.mean(axis=0))
    poses = [look_at(centre, turn, 0.0, 3.0, field.axes) for turn in 2 * np.pi * np.arange(12) / 12]
    mesh = build_surface(field, Cameras(tuple(Camera(64, 64, 90.0, pose) for pose in poses)))
    cells = mesh.positions @ field.place[:, :3].T + field.place[:, 3]
    assert np.linalg.norm(cells[:, :2] - 16, axis=1).min() > 6  # with the lids 4.5


def test_the_same_bytes_on_any_number_of_threads() -> None:
    code = "from tests.stages.test_field_to_surface import digest; print(digest())"
    environment = os.environ | {"NUMBA_NUM_THREADS": "1"}
    done = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == digest()


def digest() -> str:
    mesh = surface(build_field(sample_n3tree(resolution=32)), triangles=1000)
    return hashlib.sha256(mesh.positions.tobytes() + mesh.faces.tobytes()).hexdigest()


@pytest.mark.slow
def test_a_sample_has_no_face_twice_none_without_area_and_none_turned_over() -> None:
    field = build_field(sample_n3tree(resolution=64))
    for triangles in (20_000, 2_000):
        mesh = surface(field, triangles=triangles)
        assert 0.5 * triangles < len(mesh.faces) <= triangles
        assert not turned_over(mesh.positions.astype(np.float64), mesh.faces).any()
        assert len(np.unique(np.sort(mesh.faces, axis=1), axis=0)) == len(mesh.faces)
        assert solid(mesh).is_winding_consistent
        assert solid(mesh).area_faces.min() > 0


def test_small_islands_are_left_out_and_all_but_the_largest_on_request() -> None:
    field = balls(((10, 10, 10), 7), ((24, 24, 24), 5), ((5, 26, 26), 1.2))
    assert solid(surface(field)).body_count == 2
    assert solid(surface(field, largest=True)).body_count == 1


def test_what_is_outside_of_the_box_is_left_out() -> None:
    field = balls(((10, 10, 10), 7), ((24, 24, 24), 5))
    low, high = field.world(np.array([[0.0, 0, 0], [18, 18, 18]]))
    mesh = surface(field, box=np.stack([low, high]))
    assert (mesh.positions < high + 1 / EDGE).all()
    with pytest.raises(InvalidScene, match="the box contains no part of the field"):
        surface(field, box=np.array([[5.0, 5, 5], [6, 6, 6]]))


def test_a_surface_keeps_to_its_allowance() -> None:
    field = build_field(sample_n3tree(resolution=32))
    with memory_limit(200_000), pytest.raises(MemoryLimit):
        surface(field)
