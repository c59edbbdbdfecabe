from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake import build_octree, cut_octree
from nerfbake.errors import InvalidScene
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import n3tree, octrees


@given(octrees(), st.data())
def test_a_cut_is_the_start_of_what_was_there(octree: SparseVoxelOctree, draw: st.DataObject) -> None:
    level = draw.draw(st.integers(0, octree.grid_level))
    cut = cut_octree(octree, level=level)
    assert cut.problems() == []
    assert cut.layout == octree.layout or cut.n == 0
    assert cut.level_sizes == octree.level_sizes[: level + 1]
    assert_array_equal(cut.node_data, octree.node_data[: cut.n])
    kept = cut.n - cut.level_sizes[-1]
    assert_array_equal(cut.node_children[:kept], octree.node_children[:kept])
    assert not cut.node_children[kept:].any()


def test_the_grid_is_coarsened_in_place() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 1, 1))]), resolution=(5, 4, 8))
    cut = cut_octree(octree, level=2)
    assert cut.size == (3, 2, 4)
    assert_array_equal(cut.origin, octree.origin)
    assert_array_equal(cut.voxel_size, octree.voxel_size * 2)


@pytest.mark.parametrize("level", [-1, 3])
def test_a_level_that_there_is_not_is_refused(level: int) -> None:
    octree = build_octree(n3tree(), resolution=4)
    with pytest.raises(InvalidScene, match=f"level is {level}; allowed: 0 to 2"):
        cut_octree(octree, level=level)


def test_an_empty_octree_can_be_cut() -> None:
    empty = build_octree(n3tree(data=np.zeros((1, 2, 2, 2, 4), np.float16)), resolution=8)
    assert cut_octree(empty, level=1).size == (2, 2, 2)
