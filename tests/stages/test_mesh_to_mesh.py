"""Meshes with fewer triangles."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from nerfbake import simplify_surface
from nerfbake.errors import InvalidScene
from nerfbake.kernels.surface.triangles import turned_over
from nerfbake.scene.mesh import Mesh
from tests.support.meshes import sphere


def test_a_ball_stays_a_ball() -> None:
    ball = sphere(64, 128)
    simpler = simplify_surface(ball, triangles=600)
    assert 400 < len(simpler.faces) <= 600
    found = trimesh.Trimesh(simpler.positions, simpler.faces, process=False)
    assert found.is_volume
    np.testing.assert_allclose(np.linalg.norm(simpler.positions, axis=1), 1, atol=0.02)


@pytest.mark.parametrize("exponent", [-14, -7, 3, 10, 17, 20])
def test_the_unit_of_the_world_changes_nothing_but_the_positions(exponent: int) -> None:
    """The limits of the library are absolute: a ball of 2^-7 was 10 % off, and one of 2^17 kept 15,082 triangles."""
    ball, unit = rough_sphere(), np.float32(2.0**exponent)
    simpler = simplify_surface(ball, triangles=1500)
    scaled = simplify_surface(replace(ball, positions=ball.positions * unit), triangles=1500)
    np.testing.assert_array_equal(scaled.faces, simpler.faces)
    np.testing.assert_array_equal(scaled.positions, simpler.positions * unit)
    assert 1470 < len(simpler.faces) <= 1500


def test_a_ball_far_from_the_origin_is_as_round() -> None:
    ball = sphere(64, 128)
    away = np.array([3e5, -5e5, 1e5], np.float32)
    simpler = simplify_surface(replace(ball, positions=ball.positions * 64 + away), triangles=1500)
    assert len(simpler.faces) == 1500
    np.testing.assert_allclose(np.linalg.norm(simpler.positions - away, axis=1), 64, rtol=0.004)


def test_so_many_triangles_as_are_asked_for() -> None:
    """One call of the library ends with 129 triangles of this sheet of noise."""
    assert len(simplify_surface(rough_sheet(), triangles=50).faces) <= 50


def test_few_triangles_are_refused() -> None:
    with pytest.raises(InvalidScene, match="triangles are 3; allowed: 4 or more"):
        simplify_surface(sphere(), triangles=3)


def test_a_rough_surface_has_no_face_that_looks_inwards() -> None:
    ball, random = sphere(64, 128), np.random.default_rng(0)
    rough = replace(ball, positions=ball.positions + random.normal(0, 0.02, ball.positions.shape).astype(np.float32))
    assert turned_over(rough.positions.astype(np.float64), rough.faces).sum() > 100
    simpler = simplify_surface(rough, triangles=2000)
    assert len(simpler.faces) > 1900
    assert not turned_over(simpler.positions.astype(np.float64), simpler.faces).any()
    found = trimesh.Trimesh(simpler.positions, simpler.faces, process=False)
    assert found.area_faces.min() > 0
    assert len(np.unique(np.sort(simpler.faces, axis=1), axis=0)) == len(simpler.faces)


def test_the_same_surface_in_one_thread_and_in_another_process() -> None:
    """The library collapses in one thread: the bytes hang neither on threads nor on the process."""
    here = digest()
    code = "from tests.stages.test_mesh_to_mesh import digest; print(digest())"
    environment = os.environ | {"NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    there = subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True)
    assert there.stdout.strip() == here


def rough_sphere() -> Mesh:
    ball, random = sphere(64, 128), np.random.default_rng(0)
    return replace(ball, positions=ball.positions + random.normal(0, 0.005, ball.positions.shape).astype(np.float32))


def rough_sheet(n: int = 96) -> Mesh:
    """n x n vertices of distance 1, with random heights."""
    x, y = np.meshgrid(np.arange(float(n)), np.arange(float(n)), indexing="ij")
    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).reshape(-1)
    quads = np.stack([corner, corner + n, corner + n + 1, corner + 1], axis=1)
    faces = quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3).astype(np.uint32)
    heights = np.random.default_rng(0).normal(0, 10, x.size)
    return Mesh(np.column_stack([x.ravel(), y.ravel(), heights]).astype(np.float32), None, faces)


def digest() -> str:
    simpler = simplify_surface(sphere(64, 128), triangles=600)
    return hashlib.sha256(simpler.positions.tobytes() + simpler.faces.tobytes()).hexdigest()
