from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_array_equal

from nerfbake import build_octree, build_vdb, restore_octree
from nerfbake.errors import InvalidScene
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import Volume
from tests.scenes import assert_same_octree, n3tree, n3trees, octrees, world_centres


@given(n3trees())
def test_an_octree_at_its_trees_own_resolution_comes_back_to_the_bit(tree: N3Tree) -> None:
    octree = build_octree(tree)
    assert_same_octree(restore_octree(build_vdb(octree, grids=("index",))), octree)
    assert_same_octree(restore_octree(build_vdb(octree, grids=("density", "sh"))), octree)


@given(octrees())
def test_every_voxel_comes_back_and_then_nothing_changes(octree: SparseVoxelOctree) -> None:
    half = octree.node_data.dtype == np.float16
    volume = build_vdb(octree, grids=("index",), half=half)
    back = restore_octree(volume)
    held = octree.sample(world_centres(octree))
    held[held[:, -1] <= 0] = 0
    assert_array_equal(back.sample(world_centres(octree)), held)
    assert (back.size, back.layout, back.data_format) == (octree.size, octree.layout, octree.data_format)
    assert_same_octree(restore_octree(build_vdb(back, grids=("index",), half=half)), back)


def test_voxels_that_hold_nothing_are_no_nodes() -> None:
    tree = n3tree(dtype=np.float32)
    tree.data[0, 0, 0, 0, 3] = 1e-9  # 0 as a half
    octree = build_octree(tree)
    assert octree.level_sizes == [1, 8]
    assert restore_octree(build_vdb(octree, grids=("index",), half=True)).level_sizes == [1, 7]


def test_grids_without_coefficients_hold_no_octree() -> None:
    octree = build_octree(n3tree())
    with pytest.raises(InvalidScene, match="has the grids density, Cd; allowed: density,sh or index"):
        restore_octree(build_vdb(octree))
    foreign = replace(build_vdb(octree, grids=("index",)), frame=None)
    with pytest.raises(InvalidScene, match="does not say which octree it was"):
        restore_octree(foreign)


def test_grids_of_two_topologies_hold_no_octree() -> None:
    octree = build_octree(n3tree())
    one, other = (build_vdb(octree, grids=("density", "sh"), sigma_min=cut) for cut in (0, 1.5))
    with pytest.raises(InvalidScene, match="grid 'sh_0' differs from density"):
        restore_octree(Volume((one.grids[0], *other.grids[1:]), one.transform, one.frame))


def test_voxels_outside_the_octree_are_refused() -> None:
    volume = build_vdb(build_octree(n3tree()), grids=("index",))
    assert volume.frame is not None
    small = replace(volume, frame=replace(volume.frame, size=(1, 1, 1)))
    with pytest.raises(InvalidScene, match="has voxels outside 1x1x1"):
        restore_octree(small)
