"""A fitted field as a PlenOctree: the same values, cell for cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from numpy.testing import assert_array_equal

from nerfbake import BrickField, N3Tree, build_n3tree, load, memory_limit, save
from nerfbake.errors import InvalidScene, MemoryLimit
from tests.support.brick_fields import (
    brick_field_of,
    brick_fields,
    lattice_points,
    sampled,
    some_brick_field,
    some_shelled_field,
)

BOX = [[0.0, 0.0, 0.0], [16.0, 32.0, 64.0]]


def test_one_wide_cell_and_one_fine_cell_by_hand() -> None:
    held, wide = np.zeros((16, 16, 16), bool), np.zeros((8, 8, 8), bool)
    held[15, 0, 1], wide[4, 0, 0] = True, True  # both in the brick x = 8..15
    values = np.array([[1, 2, 3, 5], [4, 5, 6, 7]], np.float32)
    tree = build_n3tree(brick_field_of(held, wide, values, BOX))
    # The root, the brick, its blocks of 4^3 at x = 8 and x = 12, and the block of 2^3 with the fine cell.
    assert tree.n == 5
    assert (tree.levels[0].tolist(), tree.levels[1].tolist()) == ([0], [1])
    assert tree.child[0, 1, 0, 0] == 1
    assert [tree.child[1, 0, 0, 0], tree.child[1, 1, 0, 0], tree.child[3, 1, 0, 0]] == [1, 2, 1]
    assert np.count_nonzero(tree.child) == 4
    assert tree.data[2, 0, 0, 0].tolist() == [1, 2, 3, 5]
    assert tree.data[4, 1, 0, 1].tolist() == [4, 5, 6, 7]
    assert np.count_nonzero(tree.data[..., -1]) == 2
    assert tree.invradius.tolist() == [1 / 16, 1 / 32, 1 / 64]


@given(brick_fields())
def test_every_cell_keeps_its_values(field: BrickField) -> None:
    tree = build_n3tree(field)
    tree.require_usable()
    assert_array_equal(tree.sample(lattice_points(field)), sampled(field))
    assert np.count_nonzero(tree.leaf_mask & (tree.sigma > 0)) == np.count_nonzero(field.values[:, -1])


@given(brick_fields())
def test_halves_are_the_values_rounded(field: BrickField) -> None:
    tree = build_n3tree(field, dtype="float16")
    assert tree.data.dtype == np.float16
    assert_array_equal(tree.sample(lattice_points(field)), sampled(field).astype(np.float16).astype(np.float32))


def test_a_density_that_float16_rounds_to_0_is_no_leaf() -> None:
    field = some_brick_field()
    field.values[3, -1] = 1e-9
    assert np.count_nonzero(build_n3tree(field).sigma > 0) == field.n
    tree = build_n3tree(field, dtype="float16")
    assert np.count_nonzero(tree.data.any(axis=-1)) == field.n - 1


def test_the_file_holds_the_same(tmp_path: Path) -> None:
    tree = build_n3tree(some_brick_field())
    save(tmp_path / "a.npz", tree)
    back = load(tmp_path / "a.npz", N3Tree)
    assert_array_equal(back.child, tree.child)
    assert_array_equal(back.data, tree.data)


def test_a_value_that_float16_cannot_hold_is_told() -> None:
    field = some_brick_field()
    field.values[3, -1] = 1e5
    with pytest.raises(InvalidScene, match="the field holds 100000; allowed: up to 65504 for float16"):
        build_n3tree(field, dtype="float16")


def test_a_tree_that_is_too_large_is_not_begun() -> None:
    field = some_brick_field()
    with memory_limit(1 << 16), pytest.raises(MemoryLimit, match="the tree"):
        build_n3tree(field)


def test_scenery_that_is_all_far_away_is_a_sound_tree() -> None:
    field = some_shelled_field(shells=8)
    outermost = len(field.shell(7).values)
    field.values[:-outermost, -1] = 0
    tree = build_n3tree(field)
    assert tree.shells == 8
    assert tree.problems() == []
    assert not (tree.inner_cube().sigma > 0).any()
    assert np.count_nonzero(tree.sigma > 0) == outermost
