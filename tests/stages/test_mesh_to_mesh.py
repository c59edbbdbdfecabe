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
from tests.support.meshes import sphere


def test_a_ball_stays_a_ball() -> None:
    ball = sphere(64, 128)
    simpler = simplify_surface(ball, triangles=600)
    assert 400 < len(simpler.faces) <= 600
    found = trimesh.Trimesh(simpler.positions, simpler.faces, process=False)
    assert found.is_volume
    np.testing.assert_allclose(np.linalg.norm(simpler.positions, axis=1), 1, atol=0.02)


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


def digest() -> str:
    simpler = simplify_surface(sphere(64, 128), triangles=600)
    return hashlib.sha256(simpler.positions.tobytes() + simpler.faces.tobytes()).hexdigest()
