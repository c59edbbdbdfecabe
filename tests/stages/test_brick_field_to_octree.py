"""A fitted field as an octree: the same values, and inner nodes as its PlenOctree's octree has them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import (
    BrickField,
    SparseVoxelOctree,
    build_bricks,
    build_n3tree,
    build_octree,
    build_octree_from_bricks,
    fill_octree,
    sample_n3tree,
)
from nerfbake.errors import InvalidScene
from tests.support.brick_fields import brick_fields, lattice_points, sampled, some_brick_field
from tests.support.scenes import n3tree, octrees


@given(brick_fields())
def test_every_cell_keeps_its_values(field: BrickField) -> None:
    octree = build_octree_from_bricks(field)
    octree.require_usable()
    assert octree.size == (field.resolution,) * 3
    assert_array_equal(octree.sample(lattice_points(field)), sampled(field))


def test_it_is_the_octree_of_its_plenoctree() -> None:
    field = some_brick_field(empty=True)
    octree = build_octree_from_bricks(field)
    other = build_octree(build_n3tree(field), resolution=field.resolution)
    assert_array_equal(octree.node_children, other.node_children)
    assert_array_equal(octree.node_data[octree.childless], other.node_data[other.childless])
    # The length behind an opacity is the cell's, worked out in another order of steps.
    assert_allclose(octree.node_data, other.node_data, rtol=1e-6)
    assert_allclose(octree.origin, other.origin, atol=1e-15)
    assert_allclose(octree.voxel_size, other.voxel_size, rtol=1e-15)


def test_the_layout_may_be_compact() -> None:
    octree = build_octree_from_bricks(some_brick_field(), layout="compact")
    assert octree.layout == "compact"
    assert octree.c == octree.n - octree.level_sizes[-1]


def test_wide_cells_are_leaves_of_their_own_depth() -> None:
    field = some_brick_field()
    octree = build_octree_from_bricks(field)
    leaves = np.add.reduceat(octree.childless, np.cumsum([0, *octree.level_sizes[:-1]]))
    assert leaves[-2:].tolist() == [np.count_nonzero(field.wide), np.count_nonzero(~field.wide)]


@given(octrees(dtypes=(np.float32, np.float16)).filter(lambda octree: octree.data_format.startswith("SH")))
def test_an_octree_that_nobody_changed_comes_back(octree: SparseVoxelOctree) -> None:
    back = fill_octree(octree, build_bricks(octree))
    assert back.node_data.dtype == octree.node_data.dtype
    assert_array_equal(back.node_children, octree.node_children)
    # Large leaves are means of equal cells.
    points = lattice_points(build_bricks(octree))
    held = (points < octree.origin + np.array(octree.size) * octree.voxel_size).all(axis=1)
    rtol = 1e-3 if octree.node_data.dtype == np.float16 else 1e-5
    assert_allclose(back.sample(points[held]), octree.sample(points[held]), rtol=rtol, atol=rtol)


def test_values_go_into_the_leaf_around_each_cell() -> None:
    octree = build_octree(sample_n3tree(resolution=16, basis="SH1"), dtype="float16")
    field = build_bricks(octree)
    grey = replace(field, values=(np.arange(4 * field.n).reshape(-1, 4) / 64).astype(np.float32))
    found = fill_octree(octree, grey)
    assert found.level_sizes == octree.level_sizes
    fine = ~field.wide
    centres = field.box[0] + (field.corners[fine] + 0.5) * field.cell_size
    assert_array_equal(found.sample(centres), grey.values[fine].astype(np.float16))
    # An inner node shows the mean density of all that is below it.
    assert 0 < found.node_data[0, -1] < grey.values[:, -1].max()


def test_a_large_leaf_holds_the_mean_of_its_cells() -> None:
    octree = build_octree(n3tree(splits=[(0, (0, 0, 0)), (1, (0, 0, 0))]), resolution=8)
    field = build_bricks(octree)
    values = field.values.copy()
    here = (field.corners >> 2 == [1, 1, 1]).all(axis=1)
    assert np.count_nonzero(here) == 8
    values[here, -1] = np.arange(1, 9)
    values[here, 0] = np.where(np.arange(8) == 7, 1, 0)
    found = fill_octree(octree, replace(field, values=values)).sample(octree.origin + 5 * octree.voxel_size)
    weight = 1 - np.exp(-np.arange(1, 9) * octree.voxel_size[0])
    assert_allclose(found[[0, -1]], [weight[7] / weight.sum(), 4.5], rtol=1e-6)


def test_a_field_of_another_place_or_basis_or_cells_elsewhere_is_refused() -> None:
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))]), resolution=8, sigma_min=2)
    field = build_bricks(octree)
    found = r"the field does not match the octree: .*; allowed: SH1 in the octree's lattice of 8\^3"
    with pytest.raises(InvalidScene, match=found):
        fill_octree(octree, replace(field, box=2 * field.box))
    with pytest.raises(InvalidScene, match="the field has a cell at "):
        fill_octree(octree, build_bricks(build_octree(n3tree(splits=[(0, (1, 0, 1))]), resolution=8)))
