"""A fitted field as VDB grids: its bricks are leaves, and a wide cell is eight voxels."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_array_equal

from nerfbake import (
    BrickField,
    build_octree_from_bricks,
    build_octree_from_volume,
    build_vdb,
    build_vdb_from_bricks,
    memory_limit,
)
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.scene.vdb import IndexGrid
from tests.support.brick_fields import brick_fields, lattice_points, sampled, some_brick_field
from tests.support.scenes import assert_same_octree


@given(brick_fields())
def test_every_cell_keeps_its_values(field: BrickField) -> None:
    volume = build_vdb_from_bricks(field, grids=("index",))
    volume.require_usable()
    assert_array_equal(volume.grids[0].sample(volume.index_of(lattice_points(field))), sampled(field))


def test_it_is_what_its_octree_becomes() -> None:
    field = some_brick_field(empty=True)
    for grids in (("density", "Cd", "sh"), ("index",)):
        ours = build_vdb_from_bricks(field, grids=grids, up="y")
        theirs = build_vdb(build_octree_from_bricks(field), grids=grids, up="y")
        assert ours.labels == theirs.labels
        assert_array_equal(ours.transform, theirs.transform)
        for grid, other in zip(ours.grids, theirs.grids, strict=True):
            assert type(grid) is type(other)
            assert grid.topology.same_as(other.topology)
            assert_array_equal(grid.values, other.values)


def test_the_octree_comes_back() -> None:
    field = some_brick_field()
    assert_same_octree(
        build_octree_from_volume(build_vdb_from_bricks(field, grids=("index",))), build_octree_from_bricks(field)
    )


def test_halves() -> None:
    (grid,) = build_vdb_from_bricks(some_brick_field(), grids=("index",), half=True).grids
    assert isinstance(grid, IndexGrid)
    assert grid.table.dtype == np.float16


def test_grids_that_are_none_and_too_many_voxels_are_told() -> None:
    field = some_brick_field()
    with pytest.raises(InvalidScene, match="grids are 'colour'"):
        build_vdb_from_bricks(field, grids=("colour",))
    with memory_limit(1 << 13), pytest.raises(MemoryLimit, match="the field as voxels"):
        build_vdb_from_bricks(field)
