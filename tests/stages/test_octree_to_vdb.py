from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree, build_vdb
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb import IndexGrid
from tests.support.scenes import n3tree, octrees, world_centres


@given(octrees(dtypes=(np.float32,)))
def test_every_voxel_is_what_the_octree_says(octree: SparseVoxelOctree) -> None:
    grid = build_vdb(octree, grids=("index",)).grids[0]
    dense = np.zeros((*octree.size, octree.data_dim), np.float32)
    dense[tuple(grid.topology.coords.T)] = grid.values
    assert_array_equal(dense.reshape(-1, octree.data_dim), octree.sample(world_centres(octree)))


def test_a_voxel_stands_at_its_centre_in_the_world() -> None:
    octree = build_octree(n3tree(offset=np.array([0.5, 0.25, 0]), invradius=np.array([1, 0.5, 2.0])))
    volume = build_vdb(octree)
    coords = volume.grids[0].topology.coords
    world = coords @ volume.transform[:, :3].T + volume.transform[:, 3]
    assert_allclose(octree.sample(world)[:, -1:], volume.grid("density").values)
    turned = build_vdb(octree, up="y")
    x, y, z = world.T
    assert_array_equal(coords @ turned.transform[:, :3].T + turned.transform[:, 3], np.stack([x, z, -y], axis=1))
    assert_array_equal(turned.voxel_size, octree.voxel_size)


def test_the_colour_is_the_sigmoid_of_the_mean_over_directions() -> None:
    octree = build_octree(n3tree(data_format="SH9"))
    from nerfbake.kernels.march.sh import sh_basis

    random = np.random.default_rng(0).normal(size=(20_000, 3))
    directions = np.concatenate([random, -random, random[:, [1, 2, 0]], random[:, [2, 0, 1]]])
    basis = sh_basis(directions / np.linalg.norm(directions, axis=1, keepdims=True), 9)
    grid = build_vdb(octree).grid("Cd")
    coefficients = build_vdb(octree, grids=("index",)).grids[0].values[:, :27].reshape(-1, 3, 9)
    mean = coefficients @ basis.mean(axis=0)
    assert_allclose(grid.values, 1 / (1 + np.exp(-mean)), atol=2e-2)
    assert_allclose(grid.values, 1 / (1 + np.exp(-coefficients[..., 0] * 0.5 / np.sqrt(np.pi))), rtol=1e-6)


def test_rgba_has_its_colours_as_they_are() -> None:
    octree = build_octree(n3tree(data_format="RGBA"))
    volume = build_vdb(octree)
    data = build_vdb(octree, grids=("index",)).grids[0].values
    assert_allclose(volume.grid("Cd").values, 1 / (1 + np.exp(-data[:, :3])), rtol=1e-6)


def test_coefficients_come_by_basis_function() -> None:
    octree = build_octree(n3tree(data_format="SH4"))
    volume = build_vdb(octree, grids=("density", "sh"))
    data = build_vdb(octree, grids=("index",)).grids[0].values
    assert [grid.name for grid in volume.grids] == ["density", "sh_0", "sh_1", "sh_2", "sh_3"]
    for k in range(4):
        assert_array_equal(volume.grid(f"sh_{k}").values, data[:, [k, 4 + k, 8 + k]])


def test_thin_leaves_are_background() -> None:
    octree = build_octree(n3tree())
    kept = build_vdb(octree, sigma_min=1.5).grid("density")
    assert kept.topology.m == np.count_nonzero(octree.sample(world_centres(octree))[:, -1] >= 1.5)
    assert kept.values.min() >= 1.5
    assert build_vdb(octree, sigma_min=1e9).grid("density").topology.m == 0


def test_half_rounds_and_refuses_what_it_cannot_hold() -> None:
    octree = build_octree(n3tree())
    grid = build_vdb(octree, grids=("index",), half=True).grids[0]
    assert isinstance(grid, IndexGrid)
    assert grid.table.dtype == np.float16
    octree.node_data[:, -1] = 70_000
    with pytest.raises(InvalidScene, match="holds 70000; allowed: up to 65504 for `half`"):
        build_vdb(octree, half=True)


def test_memory_is_bounded_before_it_is_taken() -> None:
    solid = SparseVoxelOctree((4096,) * 3, np.zeros((1, 8), np.int32), np.ones((1, 4), np.float32), "RGBA")
    with pytest.raises(MemoryLimit, match=r"the octree as voxels needs 5.0 TiB; allowed: 4.0 GiB"):
        build_vdb(solid)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"grids": ("index", "density")}, "grids are 'index,density'"),
        ({"grids": ("colour",)}, "grids are 'colour'"),
        ({"grids": ()}, "grids are ''"),
        ({"up": "x"}, "up is 'x'; allowed: y, z"),
        ({"sigma_min": -1.0}, "sigma_min is -1"),
    ],
)
def test_wrong_options(options: Any, said: str) -> None:
    with pytest.raises(InvalidScene) as error:
        build_vdb(build_octree(n3tree()), **options)
    assert said in str(error.value)


def test_lobes_have_no_colour_of_their_own() -> None:
    octree = build_octree(n3tree(data_format="SG2", extra_data=np.ones((2, 4), np.float32)))
    with pytest.raises(InvalidScene, match="grid 'Cd' is not available for data_format 'SG2'; allowed: SH and RGBA"):
        build_vdb(octree)
    assert build_vdb(octree, grids=("density", "sh")).frame is not None
