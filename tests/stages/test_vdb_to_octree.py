from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import (
    build_field,
    build_octree,
    build_octree_from_density,
    build_octree_from_volume,
    build_vdb,
    orbit_cameras,
    render_field,
)
from nerfbake.errors import InvalidScene
from nerfbake.kernels.vdb.bitmask import slots_of
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.vdb_topology import VdbTiles, VdbTopology, topology_of
from nerfbake.scene.volume import Volume
from tests.support.scenes import assert_same_octree, n3tree, n3trees, octrees, world_centres


@given(n3trees())
def test_an_octree_at_its_trees_own_resolution_comes_back_to_the_bit(tree: N3Tree) -> None:
    octree = build_octree(tree)
    assert_same_octree(build_octree_from_volume(build_vdb(octree, grids=("index",))), octree)
    assert_same_octree(build_octree_from_volume(build_vdb(octree, grids=("density", "sh"))), octree)


@given(octrees())
def test_every_voxel_comes_back_and_then_nothing_changes(octree: SparseVoxelOctree) -> None:
    half = octree.node_data.dtype == np.float16
    volume = build_vdb(octree, grids=("index",), half=half)
    back = build_octree_from_volume(volume)
    held = octree.sample(world_centres(octree))
    held[held[:, -1] <= 0] = 0
    assert_array_equal(back.sample(world_centres(octree)), held)
    assert (back.size, back.layout, back.data_format) == (octree.size, octree.layout, octree.data_format)
    assert_same_octree(build_octree_from_volume(build_vdb(back, grids=("index",), half=half)), back)


def test_voxels_that_hold_nothing_are_no_nodes() -> None:
    tree = n3tree(dtype=np.float32)
    tree.data[0, 0, 0, 0, 3] = 1e-9  # 0 as a half
    octree = build_octree(tree)
    assert octree.level_sizes == [1, 8]
    assert build_octree_from_volume(build_vdb(octree, grids=("index",), half=True)).level_sizes == [1, 7]


def test_grids_without_coefficients_hold_no_octree() -> None:
    octree = build_octree(n3tree())
    with pytest.raises(InvalidScene, match="has the grids density, Cd; allowed: density,sh or index"):
        build_octree_from_volume(build_vdb(octree))
    foreign = replace(build_vdb(octree, grids=("index",)), frame=None)
    with pytest.raises(InvalidScene, match="does not describe an octree"):
        build_octree_from_volume(foreign)


def test_grids_of_two_topologies_hold_no_octree() -> None:
    octree = build_octree(n3tree())
    one, other = (build_vdb(octree, grids=("density", "sh"), sigma_min=cut) for cut in (0, 1.5))
    with pytest.raises(InvalidScene, match="grid 'sh_0' differs from density"):
        build_octree_from_volume(Volume((one.grids[0], *other.grids[1:]), one.transform, one.frame))


def test_voxels_outside_the_octree_are_refused() -> None:
    volume = build_vdb(build_octree(n3tree()), grids=("index",))
    assert volume.frame is not None
    small = replace(volume, frame=replace(volume.frame, size=(1, 1, 1)))
    with pytest.raises(InvalidScene, match="has voxels outside 1x1x1"):
        build_octree_from_volume(small)


# -- density alone ---------------------------------------------------------------------------------------------
def tiled() -> VdbTopology:
    """A voxel at (-1, 2, 3), a tile of 8^3 at (8, 0, 0) and one of 128^3 at (128, -128, 0)."""
    topology, _ = topology_of(np.array([[-1, 2, 3], [9, 1, 1], [129, -127, 1]]))
    lower, upper = np.zeros_like(topology.lower_mask), np.zeros_like(topology.upper_mask)
    leaf = int(np.flatnonzero((topology.leaf_origin == [8, 0, 0]).all(axis=1))[0])
    nodes = topology.nodes_at(np.array([[9, 1, 1], [129, -127, 1]]))
    row, slot = slots_of(topology.lower_mask)
    lower[row[leaf], slot[leaf] >> 6] |= np.uint64(1) << np.uint64(slot[leaf] & 63)
    row, slot = slots_of(topology.upper_mask)
    big = int(nodes[1][1])
    upper[row[big], slot[big] >> 6] |= np.uint64(1) << np.uint64(slot[big] & 63)
    keep_lower = np.arange(len(topology.lower_mask)) != big
    keep_leaf = np.isin(np.arange(len(topology.leaf_mask)), [leaf, int(nodes[2][1])], invert=True)
    lower_mask = (topology.lower_mask & ~lower)[keep_lower]
    made = VdbTopology(
        topology.root_origin,
        topology.upper_mask & ~upper,
        lower_mask,
        topology.leaf_mask[keep_leaf],
        VdbTiles(lower[keep_lower], upper, np.zeros((0, 3), np.int32)),
    )
    assert made.structure_problems() == []
    assert (made.m, made.tile_counts) == (1, (1, 1, 0))
    return made


def fog(values: list[float], matrix: npt.ArrayLike | None = None) -> Volume:
    grid = VdbTree("smoke", tiled(), np.array(values, np.float32)[:, None], np.zeros(1, np.float32))
    turned = np.diag([0.5, 1, 2]) if matrix is None else np.asarray(matrix)
    return Volume((grid,), np.column_stack([turned, [1.0, 2.0, 3.0]]))


TURNS = {
    "as it is": np.diag([0.5, 1, 2]),
    "mirrored": np.diag([0.5, -1, 2]),
    "y up": np.array([[0.5, 0, 0], [0, 0, 1.0], [0, -2, 0]]),
}


@pytest.mark.parametrize("turn", TURNS)
def test_tiles_are_leaves_where_they_stand(turn: str) -> None:
    """By hand: three leaves, at the levels of 1, 8 and 128 voxels; every voxel of the world has the grid's value."""
    volume = fog([1.5, 2.5, 3.5], TURNS[turn])
    octree = build_octree_from_density(volume)
    assert octree.problems() == []
    assert (octree.data_dim, octree.data_format) == (1, "")
    leaves = [int(np.count_nonzero(part)) for part in np.split(octree.childless, np.cumsum(octree.level_sizes)[:-1])]
    height = octree.grid_level
    assert [leaves[height - level] for level in (0, 3, 7)] == [1, 1, 1]
    assert sum(leaves) == 3
    random = np.random.default_rng(1)
    voxels = np.concatenate([random.integers(-140, 270, (2000, 3)), random.integers(-3, 20, (2000, 3))])
    world = voxels @ volume.transform[:, :3].T + volume.transform[:, 3]
    assert_array_equal(octree.sample(world), volume.grids[0].sample(voxels))


def test_what_holds_nothing_is_no_leaf() -> None:
    octree = build_octree_from_density(fog([1.5, 0, -1]))
    assert octree.size == (1, 1, 1)
    assert_array_equal(octree.origin, [1 - 0.5 - 0.25, 2 + 2 - 0.5, 3 + 6 - 1])
    assert_array_equal(octree.node_data, [[1.5]])
    assert np.count_nonzero(build_octree_from_density(fog([0, 0, 0])).sigma) == 0


@pytest.mark.parametrize(
    ("volume", "said"),
    [
        (fog([1, 1, 1], np.array([[1, 1, 0], [0, 1, 0], [0, 0, 1.0]])), "the transform rotates or shears the grid"),
        (fog([1, 1, np.inf]), "is inf; allowed: a finite number"),
    ],
)
def test_what_no_octree_can_hold(volume: Volume, said: str) -> None:
    with pytest.raises(InvalidScene, match=said):
        build_octree_from_density(volume)


def test_a_level_set_is_no_fog() -> None:
    volume = fog([1, 1, 1])
    (grid,) = volume.grids
    assert isinstance(grid, VdbTree)
    with pytest.raises(InvalidScene, match="grid 'smoke' is a level set; allowed: a fog volume"):
        build_octree_from_density(replace(volume, grids=(replace(grid, grid_class="level set"),)))


def test_a_tile_of_sixty_nine_thousand_million_voxels_is_one_leaf() -> None:
    upper, lower, leaf = (np.zeros((0, width), np.uint64) for width in (512, 64, 8))
    tile = VdbTiles(lower, upper, np.array([[-4096, 0, 4096]], np.int32))
    topology = VdbTopology(np.zeros((0, 3), np.int32), upper, lower, leaf, tile)
    grid = VdbTree("density", topology, np.full((1, 1), 0.25, np.float32), np.zeros(1, np.float32))
    volume = Volume((grid,), np.eye(3, 4))
    octree = build_octree_from_density(volume)
    assert (octree.size, octree.n) == ((4096, 4096, 4096), 1)
    assert_array_equal(octree.origin, [-4096.5, -0.5, 4095.5])
    fields = build_field(volume), build_field(octree)
    views = orbit_cameras(fields[0], frames=1, width=8, height=6).cameras
    for lookup in ("nearest", "trilinear"):
        one, other = (render_field(field, views[0], lookup=lookup).alpha for field in fields)
        assert_allclose(one, other, atol=2e-4)  # where a ray ends, it lets 1e-4 through
