from __future__ import annotations

from unittest.mock import patch

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfbake import build_octree
from nerfbake.errors import MemoryLimit
from nerfbake.memory import memory_limit
from nerfbake.scene.n3tree import N3Tree
from nerfbake.stages.n3tree_to_octree import Resample
from tests.support.scenes import assert_same_octree, n3tree, n3trees


@given(n3trees(), st.sampled_from([1, 2, 4, 8, 16]), st.sampled_from(["mean", "nearest"]))
def test_nodes_followed_as_they_stand_are_those_of_a_descent(tree: N3Tree, edge: int, how: Resample) -> None:
    followed = build_octree(tree, resolution=edge, resample=how)
    with patch("nerfbake.kernels.octree.lockstep._halves_alike", return_value=False):
        assert_same_octree(followed, build_octree(tree, resolution=edge, resample=how))


def test_memory_is_bounded_where_nodes_are_followed() -> None:
    tree = n3tree(splits=[(0, (0, 0, 0)), (1, (0, 0, 0))])
    with memory_limit(500), pytest.raises(MemoryLimit, match="an octree of 8x8x8 voxels"):
        build_octree(tree)
