from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree
from nerfbake.errors import InvalidScene
from nerfbake.scene.octree import SparseVoxelOctree
from tests.support.scenes import n3tree, octrees, world_centres


def grid_octree(values: npt.NDArray[Any]) -> SparseVoxelOctree:
    """A 2 x 2 x 2 grid of single densities, values[x, y, z]."""
    children = np.zeros((9, 8), np.int32)
    children[0] = np.arange(1, 9)
    data = np.zeros((9, 1), np.float32)
    data[1:, 0] = values.transpose(2, 1, 0).ravel()
    return SparseVoxelOctree((2, 2, 2), children, data)


def test_nearest_reads_the_voxel() -> None:
    values = np.arange(1, 9).reshape(2, 2, 2)
    octree = grid_octree(values)
    assert octree.sample([1.5, 0.5, 1.5]) == values[1, 0, 1]
    assert octree.sample([1.0, 1.999, 0.0]) == values[1, 1, 0]
    assert_array_equal(octree.sample([[2.0, 0, 0], [-0.001, 0, 0], [np.nan, 0, 0], [np.inf, 1e300, 0]]), 0)


def test_trilinear_is_exact_on_centres_and_linear_between() -> None:
    x, y, z = np.meshgrid([0.5, 1.5], [0.5, 1.5], [0.5, 1.5], indexing="ij")
    octree = grid_octree(1 + x + 2 * y + 4 * z)
    points = np.random.default_rng(0).uniform(0.5, 1.5, (500, 3))
    assert_allclose(octree.sample(points, lookup="trilinear")[:, 0], 1 + points @ [1, 2, 4], rtol=1e-6)
    # Half way out of the grid, half of the weight lies on empty space.
    assert_allclose(octree.sample([0.0, 0.5, 0.5], lookup="trilinear"), octree.sample([0.5, 0.5, 0.5]) / 2)
    assert_array_equal(octree.sample([[-0.5, 1, 1], [2.5, 1, 1], [np.nan, 1, 1]], lookup="trilinear"), 0)


@given(octrees())
def test_trilinear_is_the_mean_of_eight_nearest_lookups(octree: SparseVoxelOctree) -> None:
    random = np.random.default_rng(0)
    p = random.uniform(-1, np.array(octree.size) + 1, (64, 3))
    base = np.floor(p - 0.5) + 0.5
    expected = np.zeros((64, octree.data_dim))
    for corner in np.ndindex(2, 2, 2):
        weight = np.where(corner, p - base, 1 - (p - base)).prod(axis=1)
        expected += weight[:, None] * octree.sample(octree.origin + (base + corner) * octree.voxel_size)
    found = octree.sample(octree.origin + p * octree.voxel_size, lookup="trilinear")
    assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def test_an_octant_without_a_child_is_empty_though_its_parent_holds_something() -> None:
    octree = grid_octree(np.ones((2, 2, 2)))
    children = np.zeros((2, 8), np.int32)
    children[0, 5] = 1
    sparse = replace(octree, node_children=children, node_data=np.full((2, 1), 7, np.float32))
    assert_array_equal(sparse.sample(world_centres(sparse)).ravel(), [0, 0, 0, 0, 0, 7, 0, 0])


@given(octrees())
def test_order_does_not_matter_on_reading(octree: SparseVoxelOctree) -> None:
    order = np.concatenate([[0], 1 + np.random.default_rng(0).permutation(octree.n - 1)])
    rank = np.argsort(order).astype(np.int32)
    full = octree.with_layout("full")
    shuffled = replace(full, node_children=rank[full.node_children[order]], node_data=full.node_data[order])
    assert not shuffled.structure_problems() or "breadth-first" in str(shuffled.structure_problems()[0])
    back = shuffled.breadth_first()
    assert_array_equal(back.node_children, full.node_children)
    assert_array_equal(back.node_data, full.node_data)


@pytest.mark.parametrize(
    ("children", "message"),
    [
        ([[9, 0, 0, 0, 0, 0, 0, 0]], "node_children[0, 0] points to node 9"),
        ([[-5, 0, 0, 0, 0, 0, 0, 0]], "node_children[0, 0] points to node -5"),
        ([[1, 1, 2, 0, 0, 0, 0, 0]], "node_children[0, 1] points to node 1, as another cell does"),
        ([[0, 0, 1, 0, 0, 0, 0, 0], [0, 0, 0, 1, 0, 0, 0, 0]], "node_children[1, 3] points to node 1"),
        ([[1, 0, 0, 0, 0, 0, 0, 0]], "node_children leads to 2 of 3 nodes"),
        ([[1, 0, 0, 0, 0, 0, 0, 0], [2, 0, 0, 0, 0, 0, 0, 0]], "levels below the root"),
    ],
)
def test_a_broken_table_is_refused(children: list[list[int]], message: str) -> None:
    octree = SparseVoxelOctree((2, 2, 2), np.array(children, np.int32), np.ones((3, 1), np.float32))
    assert message in str(octree.problems()[0])
    with pytest.raises(InvalidScene, match="node_children"):
        octree.sample([0.5, 0.5, 0.5])


@pytest.mark.parametrize(
    "wrong",
    [
        {"size": (0, 1, 1)},
        {"size": (1, 1, 4097)},
        {"node_children": np.zeros((1, 7), np.int32)},
        {"node_children": np.zeros((1, 8), np.int64)},
        {"node_children": np.zeros((99, 8), np.int32)},
        {"node_data": np.zeros((9, 0), np.float32)},
        {"node_data": np.zeros((9, 1), np.float64)},
        {"data_format": "SH9"},
        {"data_format": "SH10"},
    ],
)
def test_shapes_are_checked(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidScene, match="allowed"):
        replace(grid_octree(np.ones((2, 2, 2))), **wrong)  # type: ignore[arg-type]


def test_values_that_no_renderer_can_use_are_found() -> None:
    octree = build_octree(n3tree())
    octree.node_data[3, 1] = np.nan
    octree.node_data[4, -1] = -1
    found = [str(problem).split(";")[0] for problem in octree.problems()]
    assert found == ["node_data[3, 1] is nan", "sigma[4] is -1"]


@pytest.mark.parametrize("value", [0, -1, 1e-300, 1e300, np.inf, np.nan])
def test_a_world_that_nobody_can_calculate_with_keeps_an_octree_from_being_read(value: float) -> None:
    octree = build_octree(n3tree())
    octree.voxel_size[1] = value
    (problem,) = octree.structure_problems()
    assert str(problem) == f"voxel_size[1] is {value:g}; allowed: a finite number above 0, 1e-15 to 1e+15"
    octree = build_octree(n3tree())
    octree.origin[2] = value if abs(value) > 1 else -1e16
    (problem,) = octree.structure_problems()
    assert str(problem).startswith("origin[2] is ")


def test_voxels_name_what_node_data_holds() -> None:
    # SH4: red f0^0, f1^-1, f1^0, f1^1, then green, then blue, then sigma.
    data = np.arange(26, dtype=np.float32).reshape(2, 13)
    children = np.zeros((2, 8), np.int32)
    children[0, 3] = 1
    voxels = SparseVoxelOctree((2, 2, 2), children, data, "SH4").voxels
    assert voxels["red"].dtype.names == ("f0_0", "f1_m1", "f1_0", "f1_p1")
    assert voxels["red"]["f1_m1"].tolist() == [1, 14]
    assert voxels[1]["green"].tolist() == (17, 18, 19, 20)
    assert voxels["blue"]["f1_p1"].tolist() == [11, 24]
    assert voxels["sigma"].tolist() == [12, 25]
    assert np.shares_memory(voxels, data)
    lobes = SparseVoxelOctree((1, 1, 1), children[:1] * 0, data[:1, :7].astype(np.float16), "SG2").voxels
    assert (lobes.dtype.itemsize, lobes["blue"]["lobe1"].tolist()) == (14, [5])
    plain = SparseVoxelOctree((1, 1, 1), children[:1] * 0, data[:1, :4], "RGBA").voxels
    assert plain.tolist() == [(0, 1, 2, 3)]
    with pytest.raises(InvalidScene, match="data_format is not known; allowed: SHk"):
        SparseVoxelOctree((1, 1, 1), children[:1] * 0, data[:1, :5]).voxels.sum()
