from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree, build_vdb
from nerfbake.errors import InvalidScene
from nerfbake.kernels.vdb.accessor import dense_leaves, nearest, trilinear
from nerfbake.scene.octree import Lookup
from nerfbake.scene.vdb import READ_CHUNK
from tests.support.scenes import n3tree
from tests.support.vdb_readers import SCENES, by_coords, index, tree


@pytest.mark.parametrize("scene", SCENES)
def test_nearest_reads_every_voxel_and_the_background(scene: str) -> None:
    for grid in (tree(SCENES[scene], channels=3, dtype=np.float16, background=-2), index(SCENES[scene])):
        coords = grid.topology.coords
        around = [np.add(coords, step) for step in ([0, 0, 0], [1, 0, -1], [0, 8, 128])]
        places = np.concatenate([*around, [[0, 0, 0], [2**29, 0, 0]]])
        known, background = by_coords(coords, grid.values), tuple(grid.background.tolist())
        expected = [known.get(tuple(place), background) for place in places.tolist()]
        shuffled = np.random.default_rng(0).permutation(len(places))
        off_centre = places + np.random.default_rng(1).uniform(-0.49, 0.49, places.shape)
        assert_array_equal(grid.sample(off_centre[shuffled]), np.array(expected)[shuffled])


def test_trilinear_is_the_mean_of_eight() -> None:
    grid = tree(SCENES["a cloud"], channels=3, background=0.5)
    points = grid.topology.coords + np.random.default_rng(0).uniform(-1, 1, (grid.topology.m, 3))
    base = np.floor(points)
    expected = np.zeros((len(points), 3))
    for corner in range(8):
        step = np.array([corner >> 2, corner >> 1 & 1, corner & 1])
        weight = np.prod(np.where(step, points - base, 1 - points + base), axis=1)
        expected += weight[:, None] * grid.sample(base + step)
    assert_allclose(grid.sample(points, lookup="trilinear"), expected, rtol=1e-5)


@pytest.mark.parametrize("read", [nearest, trilinear])
@pytest.mark.parametrize("scene", SCENES)
def test_dense_leaves_read_as_masks_do(scene: str, read: Any) -> None:
    grid = tree(SCENES[scene], background=0.5)
    table = np.concatenate([grid.background[None], grid.values])
    random = np.random.default_rng(0)
    points = np.concatenate([grid.topology.coords + random.uniform(-1.2, 1.2, (grid.topology.m, 3)), np.zeros((1, 3))])
    masks, dense = np.empty((2, len(points), 1), np.float32)
    read(grid.topology.tables, False, table, points, masks)
    read(grid.topology.tables, True, dense_leaves(grid.topology.leaf_mask, table), points, dense)
    assert_array_equal(dense, masks)


def test_leaves_with_little_in_them_stay_sparse() -> None:
    # A hostile file of a million leaves of one voxel each must not become 2 GB in memory.
    assert tree(SCENES["a full leaf"]).rows.dense
    assert len(tree(SCENES["one voxel"]).rows.table) == 2


def test_many_points_read_as_each_does_alone() -> None:
    grid = tree(SCENES["a cloud"], background=0.5)
    random = np.random.default_rng(0)
    voxels = grid.topology.coords[random.integers(0, grid.topology.m, 3 * READ_CHUNK + 7)]
    points = voxels + random.uniform(-2, 2, voxels.shape)
    together = grid.sample(points, lookup="trilinear")
    some = np.arange(0, len(points), 997)
    alone = np.concatenate([grid.sample(points[i], lookup="trilinear") for i in some])
    assert_array_equal(together[some, 0], alone)
    assert len(np.unique(alone)) > len(some) / 10


@pytest.mark.parametrize("lookup", ["nearest", "trilinear"])
@pytest.mark.parametrize("up", ["y", "z"])
def test_the_world_reads_as_in_the_octree(lookup: Lookup, up: str) -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1)), (1, (0, 0, 0))], data_format="SH4", offset=np.full(3, 0.25)))
    volume = build_vdb(octree, grids=("index",), up="y" if up == "y" else "z")
    points = np.random.default_rng(0).uniform(-0.5, 1.2, (400, 3))
    turned = points[:, [0, 2, 1]] * [1, 1, -1] if up == "y" else points
    read = volume.grids[0].sample(volume.index_of(turned), lookup=lookup)
    assert_allclose(read, octree.sample(points, lookup=lookup), rtol=1e-5, atol=1e-6)
    assert np.count_nonzero(read[:, -1]) > 50


def test_what_is_no_place_reads_as_background() -> None:
    grid = tree(SCENES["one voxel"], background=3)
    far = [[np.nan, 0, 0], [np.inf, 0, 0], [1e300, 0, 0], [0, -(2.0**40), 0]]
    for lookup in ("nearest", "trilinear"):
        assert_array_equal(grid.sample(far, lookup=lookup), 3)
    assert grid.sample(np.zeros((2, 0, 3))).shape == (2, 0, 1)
    with pytest.raises(InvalidScene, match="lookup is 'cubic'"):
        grid.sample([0, 0, 0], lookup="cubic")  # type: ignore[arg-type]
