"""Meshes with fewer triangles."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from nerfbake import simplify_surface
from nerfbake.errors import InvalidScene
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
