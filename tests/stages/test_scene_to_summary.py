from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
from hypothesis import given

from nerfbake import build_octree, summarise_scene
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import n3tree, n3trees, octrees
from tests.support.vdb_readers import tree as voxels
from tests.support.vdb_readers import volume


def test_a_tree_by_hand() -> None:
    tree = n3tree(splits=[(0, (1, 0, 1))], invradius=np.full(3, 0.5), offset=np.full(3, 0.5))
    tree.data[0, 0, 0, 0, -1] = 0
    facts = summarise_scene(tree)
    assert facts["resolution"] == [4, 4, 4]
    assert facts["nodes_per_level"] == [1, 1]
    assert facts["leaves_per_level"] == [0, 7, 8]
    assert facts["occupied_per_level"] == [0, 6, 8]
    assert facts["world_box"] == [[-1, -1, -1], [1, 1, 1]]
    assert facts["non_finite"] == 0


def test_an_octree_by_hand() -> None:
    facts = summarise_scene(build_octree(n3tree(splits=[(0, (1, 0, 1))])))
    assert facts["nodes_per_level"] == [1, 8, 8]
    assert facts["leaves_per_level"] == [0, 7, 8]
    assert facts["ranges"]["sigma"] == [1, 2.875]


@given(n3trees())
def test_any_tree_fits_into_json(tree: N3Tree) -> None:
    assert json.loads(json.dumps(summarise_scene(tree), allow_nan=False)) == summarise_scene(tree)


@given(octrees())
def test_any_octree_fits_into_json(octree: SparseVoxelOctree) -> None:
    assert json.loads(json.dumps(summarise_scene(octree), allow_nan=False)) == summarise_scene(octree)


def test_a_volume_too_large_for_float64_still_has_a_summary() -> None:
    one = volume(voxels([[0, 0, 0]]))
    wide = replace(one, transform=one.transform * 1e300)
    facts = summarise_scene(wide)
    assert facts["grids"]["density"]["voxel_size"] is None
    json.dumps(facts, allow_nan=False)
    assert wide.problems()[0].place == "transform[0, 0]"


def test_broken_values_are_counted() -> None:
    tree = n3tree()
    tree.data[0, 0, 0, 1, :2] = np.nan
    facts = summarise_scene(tree)
    assert facts["non_finite"] == 2
    assert np.isfinite(facts["ranges"]["dc"]).all()
