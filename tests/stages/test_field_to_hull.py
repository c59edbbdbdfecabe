"""Hulls, with trimesh and the winding number as the oracles."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

from nerfbake import (
    Mesh,
    RadianceField,
    SparseVoxelOctree,
    build_field,
    build_hull,
    build_octree,
    build_vdb,
    orbit_cameras,
    render_field,
    render_meshes,
    sample_n3tree,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.memory import memory_limit
from nerfbake.scene.radiance_field import leaves_of
from tests.support.scenes import n3tree, octrees

POINTS = 700  # that the surface must go around, or not
Floats = npt.NDArray[np.float64]


def hull(field: RadianceField, level: int) -> Mesh:
    (mesh,) = build_hull(field, level=level).meshes
    return mesh


def solid(mesh: Mesh) -> Any:
    return trimesh.Trimesh(mesh.positions, mesh.faces, process=False)


def windings(mesh: Mesh, points: Floats) -> Floats:
    """(m,) how often the surface goes around each point (m, 3): 1 inside, 0 outside.

    Source: Van Oosterom and Strackee (1983), the solid angle of a triangle.
    """
    a, b, c = (
        (mesh.positions[mesh.faces[:, k]].astype(np.float64) - points[:, None]).transpose(2, 0, 1) for k in range(3)
    )
    la, lb, lc = (np.sqrt((side**2).sum(axis=0)) for side in (a, b, c))
    volume = (a * np.cross(b, c, axis=0)).sum(axis=0)
    cosine = la * lb * lc + (a * b).sum(axis=0) * lc + (b * c).sum(axis=0) * la + (c * a).sum(axis=0) * lb
    return np.asarray(np.arctan2(volume, cosine).sum(axis=1) / (2 * np.pi), np.float64)


def grid_points(field: RadianceField, edge: float) -> Floats:
    """The middles of all cubes of this edge, in cells, in the box of the field."""
    low, high = field.box
    axes = [np.arange(low[k] + edge / 2, high[k], edge) for k in range(3)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def boxes_of(field: RadianceField, level: int) -> dict[tuple[int, ...], float]:
    """What build_hull() promises, voxel by voxel: boxes that hold something, and how many voxels of the box around all
    leaves each of them has."""
    low, high = field.box
    edge = 1
    while edge * 2**level < (high - low).max():
        edge *= 2
    voxels = grid_points(field, 1.0)
    held = voxels[field.sample(field.world(voxels))[:, -1] > 0]
    found = np.unique(held // edge, axis=0)
    sizes = np.prod(np.minimum((found + 1) * edge, high) - np.maximum(found * edge, low), axis=1)
    return {tuple(box): float(size) for box, size in zip(found.astype(int).tolist(), sizes, strict=True)}


def assert_encloses(field: RadianceField, level: int) -> None:
    """The surface is closed, goes once around every box that holds something, and around no other one."""
    mesh, boxes = hull(field, level), boxes_of(field, level)
    found = solid(mesh)
    edges, count = np.unique(np.sort(found.edges, axis=1), axis=0, return_counts=True)
    assert (count % 2 == 0).all()
    # Every edge is gone along as often one way as the other.
    ways = np.zeros(len(mesh.positions) ** 2, np.int64)
    np.add.at(ways, found.edges @ [len(mesh.positions), 1], 1)
    square = ways.reshape(len(mesh.positions), -1)
    np.testing.assert_array_equal(square, square.T)
    assert len(edges)
    # The same place is one vertex, and every vertex is used.
    assert len(np.unique(mesh.positions, axis=0)) == len(mesh.positions) == len(np.unique(mesh.faces))
    voxel = 1 / abs(np.linalg.det(field.place[:, :3]))
    np.testing.assert_allclose(found.volume, sum(boxes.values()) * voxel, rtol=1e-4)
    voxels = grid_points(field, 1.0)
    edge = max(1, 1 << (int((field.box[1] - field.box[0]).max()) - 1).bit_length() >> level)
    voxels = voxels[np.linspace(0, len(voxels) - 1, min(len(voxels), POINTS)).astype(int)]
    inside = np.array([tuple(box) in boxes for box in (voxels // edge).astype(int).tolist()])
    np.testing.assert_allclose(windings(mesh, field.world(voxels)), inside, atol=1e-3)


@given(octrees(), st.integers(0, 4))
def test_a_hull_goes_around_the_boxes_that_hold_something_and_no_others(octree: SparseVoxelOctree, level: int) -> None:
    density = replace(octree, node_data=octree.node_data[:, -1:].copy(), data_format="", extra_data=None)
    field = build_field(replace(density, origin=np.full(3, 3.0), voxel_size=np.array([0.5, 0.25, 2.0])))
    if boxes_of(field, level):
        assert_encloses(field, level)


def test_one_voxel_by_hand() -> None:
    # Voxel (5, 1, 2) of 8^3, where a voxel is 0.5 x 1 x 2 and the grid starts at (10, 20, 30).
    data = np.zeros((8, 8, 8, 4), np.float32)
    data[5, 1, 2, 3] = 1
    octree = build_octree(n3tree(N=8, data=data[None], data_format="RGBA"), resolution=8)
    field = build_field(replace(octree, origin=np.array([10.0, 20, 30]), voxel_size=np.array([0.5, 1, 2])))
    mesh = hull(field, 5)
    assert (len(mesh.positions), len(mesh.faces)) == (8, 12)
    np.testing.assert_array_equal(mesh.positions.min(axis=0), [12.5, 21, 34])
    np.testing.assert_array_equal(mesh.positions.max(axis=0), [13, 22, 36])
    found = solid(mesh)
    assert (found.is_watertight, found.is_winding_consistent, found.volume) == (True, True, 1.0)


@pytest.mark.parametrize("level", range(6))
def test_a_solid_without_lone_edges_is_watertight_at_every_level(level: int) -> None:
    # A ball: no two of its boxes touch along an edge or in a corner alone.
    places = np.stack(np.meshgrid(*[np.arange(16) - 7.5] * 3, indexing="ij"), axis=-1)
    data = np.zeros((1, 16, 16, 16, 4), np.float32)
    data[0, ..., 3] = (places**2).sum(axis=-1) < 50
    field = build_field(n3tree(N=16, data=data, data_format="RGBA"))
    found = solid(hull(field, level))
    assert found.is_volume
    np.testing.assert_allclose(found.volume * 16**3, sum(boxes_of(field, level).values()), rtol=1e-5)


def test_finer_hulls_lie_in_coarser_ones_and_the_coarsest_is_the_box() -> None:
    field = build_field(sample_n3tree(resolution=32))
    volumes = [solid(hull(field, level)).volume for level in range(7)]
    assert volumes == sorted(volumes, reverse=True)
    np.testing.assert_allclose(volumes[0], np.ptp(field.world(field.box), axis=0).prod(), rtol=1e-5)
    leaves = sum(len(corners) * width**3 for corners, width in leaves_of(field.cells))
    np.testing.assert_allclose(volumes[5], leaves / field.place[0, 0] ** 3, rtol=1e-5)
    np.testing.assert_allclose(volumes[6], volumes[5])


def test_what_an_octree_holds_outside_of_its_grid_is_not_enclosed() -> None:
    # The root is a leaf of 8^3, of which the grid has 5 x 4 x 8 voxels.
    octree = build_octree(n3tree(data=np.ones((1, 2, 2, 2, 4), np.float16)), resolution=(5, 4, 8))
    mesh = hull(build_field(octree), 0)
    np.testing.assert_allclose(np.ptp(mesh.positions, axis=0), octree.voxel_size * octree.size)


def test_trees_that_split_in_three_are_enclosed() -> None:
    tree = n3tree(splits=[(0, (0, 1, 2)), (1, (2, 2, 2))], N=3)
    tree.data[0, 2, ..., -1] = 0
    for level in range(4):
        assert_encloses(build_field(tree), level)


def test_a_volume_that_is_turned_and_mirrored_has_its_outside_outside() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1)), (1, (1, 1, 1))]))
    volume = build_vdb(octree, grids=("index",), up="y")
    mirrored = replace(volume, transform=volume.transform * np.array([[-1], [1], [1]]))
    for each in (volume, mirrored):
        assert_encloses(build_field(each), 2)


def test_what_can_be_seen_is_seen_through_the_hull() -> None:
    field = build_field(sample_n3tree(resolution=32))
    hulls = build_hull(field, level=4)
    for camera in orbit_cameras(field, frames=3, width=48, height=48).cameras:
        covered = render_meshes(hulls, camera).alpha > 0
        seen = render_field(field, camera).alpha > 0
        assert seen.any()
        assert not (seen & ~covered).any()
        assert covered.mean() < 0.9


def test_nothing_and_a_level_that_there_is_not_are_refused() -> None:
    empty = build_field(n3tree(data=np.zeros((1, 2, 2, 2, 4), np.float16)))
    with pytest.raises(InvalidScene, match="has no leaf with a density"):
        build_hull(empty)
    for level in (-1, 13):
        with pytest.raises(InvalidScene, match=f"level is {level}; allowed: 0 to 12"):
            build_hull(build_field(n3tree()), level=level)


def test_a_hull_keeps_to_its_allowance() -> None:
    field = build_field(sample_n3tree(resolution=32))
    with memory_limit(100_000), pytest.raises(MemoryLimit, match="the hull's"):
        build_hull(field, level=12)
