from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidScene
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.vdb_voxels import topology_of
from nerfbake.scene.volume import Volume
from tests.vdb_readers import SCENES, index, transform, tree

coordinates = st.integers(-(2**20), 2**20) | st.integers(-9, 9)


def test_a_tree_by_hand() -> None:
    # Two voxels of one leaf, one of the next leaf on z, one of the next upper node on x.
    topology, order = topology_of(np.array([[4096, 0, 0], [0, 0, 8], [0, 1, 0], [0, 0, 7]]))
    assert_array_equal(order, [3, 2, 1, 0])
    assert topology.node_counts == (2, 2, 3)
    assert_array_equal(topology.root_origin, [[0, 0, 0], [4096, 0, 0]])
    assert_array_equal(topology.leaf_origin, [[0, 0, 0], [0, 0, 8], [4096, 0, 0]])
    assert topology.leaf_mask[0, 0] == 1 << 7 | 1 << 8
    assert topology.lower_mask[0, 0] == 0b11
    assert_array_equal(topology.first, [0, 2, 3])


@given(st.sets(st.tuples(coordinates, coordinates, coordinates), max_size=60))
def test_the_voxels_are_those_that_were_given(voxels: set[tuple[int, int, int]]) -> None:
    coords = np.array(list(voxels), np.int64).reshape(-1, 3)
    topology, order = topology_of(coords)
    assert topology.structure_problems() == []
    assert_array_equal(topology.coords, coords[order])
    if voxels:
        assert topology.box is not None
        assert_array_equal(topology.box, [coords.min(axis=0), coords.max(axis=0)])


def test_a_voxel_may_not_come_twice() -> None:
    with pytest.raises(InvalidScene, match=r"voxel \(1, 2, 3\) is there twice; allowed: each voxel once"):
        topology_of(np.array([[1, 2, 3], [0, 0, 0], [1, 2, 3]]))


def test_beyond_32_bits_there_are_no_voxels() -> None:
    with pytest.raises(InvalidScene, match="lies at 2147483648; allowed: coordinates of 32 bits"):
        topology_of(np.array([[2**31, 0, 0]]))


def test_masks_that_disagree_are_found() -> None:
    topology = tree(SCENES["a cloud"]).topology
    for name in ("upper_mask", "lower_mask"):
        mask = getattr(topology, name).copy()
        mask[0, 0] ^= np.uint64(1)
        assert replace(topology, **{name: mask}).structure_problems()[0].place == name
    doubled = replace(topology, root_origin=topology.root_origin[::-1].copy())
    assert "out of order" in str(doubled.structure_problems()[0])
    assert "multiples of 4096" in str(replace(topology, root_origin=topology.root_origin + 1).structure_problems()[0])


def test_values_that_are_not_the_voxels_are_found() -> None:
    good = tree(SCENES["one voxel"])
    two = VdbTree("density", good.topology, np.ones((2, 1), np.float32), good.background)
    with pytest.raises(InvalidScene, match="grid 'density' has 2 values; allowed: 1, one a voxel"):
        Volume((two,), transform()).require_sound()
    nan = VdbTree("density", good.topology, np.full((1, 1), np.nan, np.float32), good.background)
    assert str(Volume((nan,), transform()).problems()[0]) == "density[0, 0] is nan; allowed: a finite number"
    flat = Volume((good,), np.zeros((3, 4)))
    assert "cannot be inverted" in str(flat.problems()[0])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: tree([[0, 0, 0]], channels=2), "(m, 1 or 3) float16 or float32"),
        (lambda: tree([[0, 0, 0]], dtype=np.float64), "dtype float64"),
        (lambda: IndexGrid("index", index([]).topology, np.zeros((0, 4), np.float32)), "has shape (0, 4)"),
        (lambda: Volume((), transform()), "has no grids"),
        (lambda: Volume((tree([]),), np.zeros((4, 4))), "transform has shape (4, 4)"),
        (lambda: replace(tree([]).topology, leaf_mask=np.zeros((1, 8), np.int64)), "dtype int64"),
    ],
)
def test_shapes_are_held_to(make: object, said: str) -> None:
    assert callable(make)
    with pytest.raises(InvalidScene) as error:
        make()
    assert said in str(error.value)


def test_an_index_grid_has_the_background_in_row_0() -> None:
    grid = index([[0, 0, 0], [5, 5, 5]])
    assert_array_equal(grid.values, grid.table[1:])
    assert_array_equal(grid.background, 0)
