"""Normals, and vertices at one position, worked out by hand."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.surface.normals import welded, welded_normals
from tests.support.meshes import cube, sphere


def test_an_edge_leans_towards_the_larger_triangle() -> None:
    positions = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 3], [9, 9, 9]], np.float32)
    faces = np.array([[0, 1, 2], [0, 3, 1]], np.uint32)  # areas 1/2 along z, 3/2 along y
    normals = welded_normals(positions, faces)
    root = np.sqrt(10)
    np.testing.assert_allclose(
        normals, [[0, 3 / root, 1 / root], [0, 3 / root, 1 / root], [0, 0, 1], [0, 1, 0], [0, 0, 1]], atol=1e-7
    )


def test_a_cubes_corners_point_away_from_it() -> None:
    box = cube()
    np.testing.assert_array_equal(np.sign(welded_normals(box.positions, box.faces)), np.sign(box.positions))


def test_vertices_at_one_place_share_a_normal() -> None:
    ball = sphere(6, 8)
    loose = ball.positions[ball.faces].reshape(-1, 3)
    faces = np.arange(len(loose), dtype=np.uint32).reshape(-1, 3)
    shared = welded_normals(ball.positions, ball.faces)[ball.faces].reshape(-1, 3)
    np.testing.assert_allclose(welded_normals(loose, faces), shared, atol=1e-6)


def test_minus_zero_is_the_same_position_as_zero() -> None:
    positions = np.array([[0, 1, 2], [0, 1, 3], [-0.0, 1, 2]], np.float32)
    first, place = welded(positions)
    assert place[0] == place[2] != place[1]
    assert first[place].tolist() == [0, 1, 0]
