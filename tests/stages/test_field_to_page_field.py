from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings

from nerfbake import PageField, build_field, build_octree, build_page_field, sample_n3tree
from nerfbake.errors import InvalidScene
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.page import ALL, WHOLE, WIDE
from tests.support.fields import assert_same_samples
from tests.support.scenes import n3tree, n3trees, octrees


def test_leaves_by_hand() -> None:
    # The root splits its cell (1, 0, 1), and that one its own (0, 0, 0): voxels of 1, leaves of 2, and leaves of 4.
    tree = n3tree(splits=[(0, (1, 0, 1)), (1, (0, 0, 0))])
    found = build_page_field(build_field(tree))
    assert found.top.tolist() == [[[0]]]
    whole = found.blocks[:, 3] == ALL
    # Seven leaves of 4^3 are rows of their own, behind the 8 voxels and the 7 leaves of 2^3, which have one bit each.
    assert whole.tolist() == [True] * 5 + [False] + [True] * 2
    assert found.blocks[whole, 2].tolist() == [15, 16, 17, 18, 19, 20, 21]
    lower = sum(1 << bit for bit in (0, 1, 4, 5, 16, 17, 20, 21, 2, 8, 10))
    assert found.blocks[5].tolist() == [lower, 0b0101_0000_0101, 0, 11 | 0b1111_1110 << WIDE]
    assert len(found.texels) == 15 + 7
    corners = np.array([[4, 0, 4], [5, 1, 5], [4, 0, 6], [5, 1, 7], [7, 3, 7]])
    assert found.rows(corners + 0.5).tolist() == [0, 10, 2, 2, 14]


def test_a_leaf_of_many_cells_is_one_row_and_distances_lead_to_what_is_not_empty() -> None:
    child = np.zeros((1, 2, 2, 2), np.int32)
    data = np.zeros((1, 2, 2, 2, 4), np.float16)
    data[0, 1, 0, 0, 3] = 5
    coarse = build_octree(N3Tree(child=child, data=data, data_format="SH1", offset=np.zeros(3), invradius=np.ones(3)))
    field = build_field(coarse)
    # As cells of 32: the leaf is 16 wide, and the rest of a grid around a far corner is empty.
    cells = field.cells._replace(edge=32, width=np.array([16.0]), shift=np.array([4]))
    wide = replace(field, cells=cells, box=np.array([[0.0] * 3, [32.0] * 3]))
    found = build_page_field(wide)
    assert found.top.shape == (4, 4, 4)
    assert (found.top[2:, :2, :2] == WHOLE).all()
    assert len(found.texels) == 1
    assert found.top[0, 0, 0] == -2
    assert found.top[1, 0, 0] == -1
    assert found.top[3, 3, 0] == -2


@settings(max_examples=30)
@given(n3trees())
def test_every_voxel_of_a_tree_is_what_its_field_says(tree: N3Tree) -> None:
    if tree.data_format in ("SG2", "ASG2"):
        return
    field = build_field(tree)
    if len(field.values):
        assert_same_samples(build_page_field(field), field)


@settings(max_examples=30)
@given(octrees())
def test_every_voxel_of_an_octree_is_what_its_field_says(octree: object) -> None:
    try:
        field = build_field(octree)  # type: ignore[arg-type]
        found = build_page_field(field)
    except InvalidScene:  # SG, what nobody knows the basis of, and leaves that are all outside of the grid
        return
    assert_same_samples(found, field)


def test_a_finer_scene() -> None:
    field = build_field(sample_n3tree(resolution=64, basis="SH25"))
    assert_same_samples(build_page_field(field), field)


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e7])
def test_densities_that_float16_does_not_hold_have_a_unit(scale: float) -> None:
    field = build_field(sample_n3tree(resolution=16))
    values = field.values.copy()
    values[:, -1] *= np.float32(scale)
    other = replace(field, values=values)
    found = build_page_field(other)
    assert (found.density_unit == 1) == (scale == 1)
    np.testing.assert_allclose(found.values[:, -1].max(), values[:, -1].max(), rtol=1e-3)
    assert_same_samples(found, other)


def test_nothing_to_see_is_refused() -> None:
    tree = sample_n3tree(resolution=8)
    tree.data[..., -1] = 0
    field = build_field(tree)
    with pytest.raises(InvalidScene, match="the field has no leaf with a density; allowed: at least one"):
        build_page_field(field)


def test_arrays_of_other_shapes_are_refused() -> None:
    found = build_page_field(build_field(sample_n3tree(resolution=8)))
    with pytest.raises(InvalidScene, match="the page field's blocks has shape"):
        replace(found, blocks=found.blocks[:, :2])
    assert isinstance(found, PageField)
