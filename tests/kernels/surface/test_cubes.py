"""Marching cubes, with trimesh as the oracle."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
import trimesh

from nerfbake.kernels.surface.cubes import cube_table, march_cubes
from nerfbake.kernels.surface.samples import EDGE, brick_places


def marched(values: npt.NDArray[np.float32], level: float) -> trimesh.Trimesh:
    """The surface of a dense grid, whose edges are multiples of 4."""
    X, Y, Z = (edge // EDGE for edge in values.shape)
    top = np.arange(X * Y * Z, dtype=np.int32).reshape(X, Y, Z)
    bricks = values.reshape(X, EDGE, Y, EDGE, Z, EDGE).transpose(0, 2, 4, 1, 3, 5).reshape(-1, EDGE**3)
    positions, faces = march_cubes(top, brick_places(top), np.ascontiguousarray(bricks), level)
    return trimesh.Trimesh(positions, faces, process=False)


def test_one_sample_by_hand() -> None:
    # The sample at (1, 2, 1) is 1 below the level, its neighbours 3 above: an octahedron of radius 1/4.
    values = np.full((4, 4, 4), 3, np.float32)
    values[1, 2, 1] = -1
    found = marched(values, 0.0)
    assert len(found.faces) == 8
    np.testing.assert_allclose(np.abs(found.vertices - [1, 2, 1]).sum(axis=1), 0.25)
    assert found.is_volume
    assert found.volume == pytest.approx(4 / 3 * 0.25**3)


def test_a_ball_has_its_volume_and_faces_outwards() -> None:
    places = np.stack(np.meshgrid(*[np.arange(24) - 11.5] * 3, indexing="ij"), axis=-1)
    found = marched(np.sqrt((places**2).sum(axis=-1)).astype(np.float32), 8.25)
    assert found.is_volume
    assert found.volume == pytest.approx(4 / 3 * np.pi * 8.25**3, rel=0.01)
    radius = np.linalg.norm(found.vertices - 11.5, axis=1)
    np.testing.assert_allclose(radius, 8.25, atol=0.03)


@pytest.mark.parametrize("seed", range(8))
def test_noise_has_a_closed_surface_with_two_faces_at_every_edge(seed: int) -> None:
    values = np.ones((12, 8, 8), np.float32)
    values[1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).uniform(-1, 1, (10, 6, 6))
    found = marched(values, 0.1)
    _, times = np.unique(np.sort(found.edges, axis=1), axis=0, return_counts=True)
    assert (times == 2).all()
    assert found.is_winding_consistent
    assert found.volume > 0
    assert found.area_faces.min() > 0
    assert len(np.unique(found.faces)) == len(found.vertices)


def test_every_case_is_the_opposite_of_its_complement_or_separates_corners() -> None:
    table = cube_table()
    assert table.sizes[0] == table.sizes[255] == 0
    for corner in range(8):
        assert table.sizes[1 << corner] == 1
        assert table.sizes[255 - (1 << corner)] == 1


def test_cubes_without_all_samples_have_no_triangles() -> None:
    top = np.full((2, 1, 1), -1, np.int32)
    top[0] = 0
    values = np.ones((1, 64), np.float32)
    values[0, -16:] = -1  # x = 3, next to the missing brick
    positions, faces = march_cubes(top, brick_places(top), values, 0.0)
    assert len(faces) == 2 * 9
    assert set(positions[:, 0]) == {2.5}
