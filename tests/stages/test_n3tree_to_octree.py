from __future__ import annotations

import tracemalloc
from typing import Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import build_octree, cut_octree
from nerfbake.errors import InvalidScene, MemoryLimit
from nerfbake.memory import memory_limit
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import Layout
from nerfbake.stages.n3tree_to_octree import LeafValues, Resample
from tests.support import oracle
from tests.support.scenes import assert_same_octree, n3tree, n3trees, sizes, world_centres


def test_one_split_by_hand() -> None:
    # The root splits only its cell x=1, y=0, z=1: 7 leaves at level 1, 8 at level 2.
    octree = build_octree(n3tree(splits=[(0, (1, 0, 1))]), resolution=4)
    assert octree.level_sizes == [1, 8, 8]
    # N3Tree's octants are [x][y][z], the octree's x + 2y + 4z: cell (1, 0, 1) is octant 5, row 6 of level 1.
    assert octree.node_children[6].tolist() == [9, 10, 11, 12, 13, 14, 15, 16]
    assert octree.node_children[0].tolist() == [1, 2, 3, 4, 5, 6, 7, 8]
    assert not octree.node_children[[1, 2, 3, 4, 5, 7, 8]].any()


def test_one_voxel_is_the_mean_of_everything() -> None:
    tree = n3tree()
    octree = build_octree(tree, resolution=1)
    assert octree.n == 1
    assert_allclose(octree.node_data[0], oracle.mean(tree, (1, 1, 1))[0, 0, 0], rtol=1e-6)


def test_mean_by_hand() -> None:
    # Two of eight cells hold something: densities 2 and 6, red 1 and 5. Cells are half a unit wide.
    data = np.zeros((1, 2, 2, 2, 4), np.float32)
    data[0, 0, 0, 0] = [1, 0, 0, 2]
    data[0, 1, 1, 1] = [5, 0, 0, 6]
    octree = build_octree(n3tree(data=data, data_format="SH1"), resolution=1)
    thin, thick = 1 - np.exp(-2 * 0.5), 1 - np.exp(-6 * 0.5)
    assert_allclose(octree.node_data[0, 3], (2 + 6) / 8)
    assert_allclose(octree.node_data[0, 0], (1 * thin + 5 * thick) / (thin + thick), rtol=1e-6)


@given(n3trees(), sizes)
def test_every_voxel_is_the_leaf_at_its_centre(tree: N3Tree, size: tuple[int, int, int]) -> None:
    octree = build_octree(tree, resolution=size, resample="nearest")
    assert octree.problems() == []
    assert_array_equal(octree.sample(world_centres(octree)).reshape(*size, -1), oracle.nearest(tree, size))
    assert_array_equal(tree.sample(world_centres(octree)).reshape(*size, -1), oracle.nearest(tree, size))


@given(n3trees(max_nodes=5), sizes.filter(lambda size: np.prod(size) < 130))
def test_every_voxel_is_the_mean_of_what_it_covers(tree: N3Tree, size: tuple[int, int, int]) -> None:
    octree = build_octree(tree, resolution=size)
    assert octree.problems() == []
    expected = oracle.mean(tree, size)
    assert_allclose(octree.sample(world_centres(octree)).reshape(*size, -1), expected, rtol=2e-5, atol=2e-5)


@given(n3trees())
def test_mean_and_nearest_agree_where_the_tree_is_not_finer(tree: N3Tree) -> None:
    for times in (1, 2):
        edge = tree.resolution * times
        if edge <= 32:
            mean, nearest = (build_octree(tree, resolution=edge, resample=how) for how in ("mean", "nearest"))
            leaf = mean.childless
            assert_array_equal(mean.node_children, nearest.node_children)
            assert_array_equal(mean.node_data[leaf], nearest.node_data[leaf])


@given(n3trees().filter(lambda tree: tree.N == 2), st.data())
def test_a_level_shows_what_a_bake_at_its_resolution_holds(tree: N3Tree, draw: st.DataObject) -> None:
    octree = build_octree(tree, resolution=8)
    level = draw.draw(st.integers(0, octree.grid_level))
    cut, direct = cut_octree(octree, level=level), build_octree(tree, resolution=1 << level)
    assert cut.size == direct.size
    where = world_centres(direct)
    assert_allclose(cut.sample(where), direct.sample(where), rtol=1e-4, atol=1e-5)


def test_the_mean_does_not_depend_on_how_finely_a_region_is_cut() -> None:
    # The same field, once with a solid cell as one leaf and once as eight equal ones.
    coarse = n3tree(splits=[(0, (0, 0, 0))], dtype=np.float32)
    child = np.concatenate([coarse.child, np.zeros((1, 2, 2, 2), np.int32)])
    child[0, 1, 1, 1] = 2
    data = np.concatenate([coarse.data, np.broadcast_to(coarse.data[0, 1, 1, 1], (1, 2, 2, 2, 4))])
    fine = N3Tree(child, data, np.zeros(3), np.ones(3), "SH1")
    for resolution in (1, 2, 4, 3):
        a, b = (build_octree(tree, resolution=resolution) for tree in (coarse, fine))
        assert_array_equal(a.node_children, b.node_children)
        assert_allclose(a.node_data, b.node_data, rtol=1e-6)


def test_equal_neighbours_merge_only_when_exactly_equal() -> None:
    data = np.ones((1, 2, 2, 2, 4), np.float32)
    assert build_octree(n3tree(data=data), resolution=2).level_sizes == [1]
    data[0, 1, 0, 1, 1] = np.nextafter(np.float32(1), np.float32(2))
    assert build_octree(n3tree(data=data), resolution=2).level_sizes == [1, 8]
    # In half precision the two are the same number.
    assert build_octree(n3tree(data=data), resolution=2, dtype="float16").level_sizes == [1]


def test_a_leaf_never_reaches_beyond_the_grid() -> None:
    data = np.ones((1, 2, 2, 2, 4), np.float32)
    octree = build_octree(n3tree(data=data), resolution=(3, 4, 4))
    outside = octree.origin + np.array([3.5, 1, 1]) * octree.voxel_size
    assert_array_equal(octree.sample(outside), 0)
    # 3 x 4 x 4 voxels: half of them in four whole leaves of 8, the others alone.
    assert octree.level_sizes == [1, 8, 16]


def test_nothing_at_all_is_an_empty_root() -> None:
    octree = build_octree(n3tree(data=np.zeros((1, 2, 2, 2, 4), np.float16)))
    assert octree.level_sizes == [1]
    assert not octree.node_data.any()


@given(n3trees(), sizes, st.sampled_from(["mean", "nearest"]), st.data())
def test_no_leaf_holds_nothing(tree: N3Tree, size: tuple[int, int, int], how: Resample, draw: st.DataObject) -> None:
    layout: Layout = draw.draw(st.sampled_from(["full", "compact"]))
    dtype: Literal["float32", "float16"] = draw.draw(st.sampled_from(["float32", "float16"]))
    cut = draw.draw(st.sampled_from([None, 0, 1]))
    octree = build_octree(tree, resolution=size, resample=how, layout=layout, dtype=dtype, sigma_min=cut)
    for level in range(octree.grid_level + 1):
        shown = cut_octree(octree, level=level)
        assert shown.n == 1 or (shown.sigma[shown.childless] > 0).all()


def test_voxels_across_empty_cells_are_no_nodes() -> None:
    # The filled cell reaches to 1.5 of 3 voxels an axis. The middle ones are cut by its walls, or by those between
    # empty cells: (1, 1, 2) covers four of these.
    data = np.zeros((1, 2, 2, 2, 4), np.float32)
    data[0, 0, 0, 0] = 1
    octree = build_octree(n3tree(data=data), resolution=3)
    assert octree.level_sizes == [1, 1, 8]
    # Along an axis the first voxel is filled, the second by half.
    filled = np.array([1, 0.5, 0])
    assert_allclose(octree.sample(world_centres(octree))[:, 3], np.einsum("i,j,k->ijk", *[filled] * 3).ravel())


def test_what_is_too_thin_for_half_precision_is_nothing() -> None:
    data = np.ones((1, 2, 2, 2, 4), np.float32)
    data[..., 3] = 1e-9
    assert build_octree(n3tree(data=data), dtype="float16").level_sizes == [1]
    data[0, 0, 0, 0, 3] = 6e-8  # the least that a half holds: an eighth of it would round to 0
    octree = build_octree(n3tree(data=data), dtype="float16")
    assert octree.level_sizes == [1, 1]
    assert (octree.sigma > 0).all()


def test_sigma_min_empties_thin_leaves() -> None:
    tree = n3tree()
    sigma = np.sort(tree.data[..., -1].ravel())
    octree = build_octree(tree, sigma_min=float(sigma[3]))
    assert octree.level_sizes == [1, 5]


def test_negative_density_is_refused_unless_a_cut_is_given() -> None:
    tree = n3tree()
    tree.data[0, 1, 0, 1, -1] = -0.5
    with pytest.raises(InvalidScene, match=r"data\[0, 1, 0, 1, 3\] is -0.5; allowed: a density of 0 or more"):
        build_octree(tree)
    assert build_octree(tree, sigma_min=0).level_sizes == [1, 7]


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("channel", [0, 3])
def test_values_that_are_no_numbers_are_refused(value: float, channel: int) -> None:
    tree = n3tree()
    tree.data[0, 0, 1, 1, channel] = value
    with pytest.raises(InvalidScene, match=rf"data\[0, 0, 1, 1, {channel}\] is {value:g}"):
        build_octree(tree)


def test_float16_that_cannot_hold_a_value_is_refused() -> None:
    tree = n3tree(dtype=np.float32)
    tree.data[0, 0, 0, 0, 0] = 70000
    with pytest.raises(InvalidScene, match="70000"):
        build_octree(tree, dtype="float16")


def test_means_of_huge_values_stay_finite() -> None:
    tree = n3tree(dtype=np.float32)
    tree.data[..., -1] = 1e15
    tree.data[..., 0] = 1e15 * np.arange(1, 9).reshape(1, 2, 2, 2) / 8
    assert build_octree(tree, resolution=1).problems() == []


def test_a_forward_facing_scene_is_refused() -> None:
    with pytest.raises(InvalidScene, match="forward-facing"):
        build_octree(n3tree(ndc=True))


@pytest.mark.parametrize("resolution", [0, -1, 4097, (4, 4, 0)])
def test_a_resolution_out_of_range_is_refused(resolution: int | tuple[int, int, int]) -> None:
    with pytest.raises(InvalidScene, match=r"resolution is .*; allowed: 1 to 4096"):
        build_octree(n3tree(), resolution=resolution)


def test_memory_is_bounded_before_it_is_taken() -> None:
    # Cells of a third of the cube against 4096 voxels: millions of voxels lie along the boundaries.
    with pytest.raises(MemoryLimit, match="`memory_limit`"), memory_limit(32 << 20):
        build_octree(n3tree(N=3), resolution=4096)


def test_a_resolution_of_4096_costs_only_what_is_there() -> None:
    data = np.zeros((1, 2, 2, 2, 4), np.float16)
    data[0, 1, 1, 1] = 1
    octree = build_octree(n3tree(data=data), resolution=4096)
    assert octree.level_sizes == [1, 1]
    assert octree.size == (4096, 4096, 4096)


@given(n3trees())
def test_layouts_hold_the_same(tree: N3Tree) -> None:
    full = build_octree(tree, resolution=8)
    compact = build_octree(tree, resolution=8, layout="compact")
    assert compact.c == compact.n - compact.level_sizes[-1]
    assert_same_octree(full.with_layout("compact"), compact)
    assert_same_octree(compact.with_layout("full"), full)


def test_world_transform_of_an_anisotropic_box() -> None:
    tree = n3tree(invradius=np.array([0.5, 0.25, 2]), offset=np.array([0.5, 0, 0.25]))
    octree = build_octree(tree, resolution=(4, 2, 8))
    assert_allclose(octree.origin, [-1, 0, -0.125])
    assert_allclose(octree.origin + octree.voxel_size * octree.size, [1, 4, 0.375])
    assert_array_equal(octree.sample([0.5, 3, 0.1]), tree.sample([0.5, 3, 0.1]))


def test_values_of_a_file_that_is_not_aligned_are_not_copied_as_a_whole() -> None:
    # NumPy's take() would copy all of them, again for each few thousand rows.
    raw = np.zeros(1 + 2 * 8 * 5000 * 4, np.uint8)
    data = raw[1:].view(np.float16).reshape(5000, 2, 2, 2, 4)
    tree = N3Tree(np.zeros((5000, 2, 2, 2), np.int32), data, np.zeros(3), np.ones(3), "RGBA")
    leaves = LeafValues(tree, np.zeros(8 * 5000, np.float32), 1.0, np.dtype(np.float32))
    tracemalloc.start()
    try:
        assert leaves.values(np.arange(2)).shape == (2, 4)
        assert tracemalloc.get_traced_memory()[1] < data.nbytes / 2
    finally:
        tracemalloc.stop()
