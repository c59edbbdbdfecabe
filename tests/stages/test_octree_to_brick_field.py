"""An octree as a field of bricks: what every voxel holds, and nothing that is no leaf."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_array_equal

from nerfbake import BrickField, SparseVoxelOctree, build_bricks, build_octree, build_octree_from_bricks, sample_n3tree
from nerfbake.errors import InvalidScene
from tests.support.brick_fields import brick_fields, lattice_points, sampled
from tests.support.scenes import n3tree, octrees


@given(octrees(dtypes=(np.float32,)).filter(lambda octree: octree.data_format.startswith("SH")))
def test_every_voxel_is_what_the_octree_says(octree: SparseVoxelOctree) -> None:
    field = build_bricks(octree)
    field.require_usable()
    assert_array_equal(sampled(field), octree.sample(lattice_points(field)))


@given(brick_fields())
def test_a_field_comes_back_from_its_octree(field: BrickField) -> None:
    back = build_bricks(build_octree_from_bricks(field))
    if field.values[:, -1].all():  # cells without a density do not come back
        for name in ("resolution", "box", "basis", "top", "rows", "values"):
            assert_array_equal(getattr(back, name), getattr(field, name), err_msg=name)
    assert_array_equal(sampled(back), sampled(field))


def test_leaves_of_three_levels_by_hand() -> None:
    # Two splits on the way down to 8^3: leaves 4, 2 and 1 voxels wide.
    octree = build_octree(n3tree(splits=[(0, (0, 0, 0)), (1, (0, 0, 0))]), resolution=8)
    leaves = np.add.reduceat(octree.childless, np.cumsum([0, *octree.level_sizes[:-1]]))
    field = build_bricks(octree)
    assert leaves.tolist() == [0, 7, 7, 8]
    assert [int(np.count_nonzero(field.wide)), int(np.count_nonzero(~field.wide))] == [7 * 8 + 7, 8]


def test_a_basis_that_is_not_sh_is_refused() -> None:
    with pytest.raises(InvalidScene, match="basis is RGBA"):
        build_bricks(build_octree(n3tree(data_format="RGBA")))
    with pytest.raises(InvalidScene, match="SG"):
        build_bricks(build_octree(n3tree(data_format="SG2", extra_data=np.zeros((2, 4), np.float32))))


def test_a_scene_of_many_bricks() -> None:
    octree = build_octree(sample_n3tree(resolution=32, basis="SH1"))
    field = build_bricks(octree)
    assert field.b > 20
    assert_array_equal(sampled(field), octree.sample(lattice_points(field)))
