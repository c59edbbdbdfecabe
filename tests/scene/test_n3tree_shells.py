"""Fields and PlenOctrees with an inner cube and shells of coarser cells around it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import nerfbake
from nerfbake import build_n3tree, build_octree_from_bricks
from nerfbake.errors import InvalidFile, InvalidScene
from nerfbake.kernels.fit.bricks import top_grid
from nerfbake.scene.n3tree import N3Tree
from nerfbake.stages.scene_to_summary import summarise_scene
from tests.support.brick_fields import BOX, some_shelled_field


def points(reach: float, seed: int = 1) -> Any:
    return np.random.default_rng(seed).uniform(-reach, reach, (20_000, 3))


def test_a_field_with_shells_has_the_cells_of_its_shells() -> None:
    field = some_shelled_field()
    field.require_usable()
    assert (field.resolution, field.shells) == (64, 3)
    assert "in a lattice of 64^3 and 2 shells around it" in str(field)
    parts = [field.shell(number) for number in range(3)]
    assert sum(part.n for part in parts) == field.n
    for number, part in enumerate(parts):
        part.require_usable()
        assert_array_equal(part.box, BOX * 2**number)
        inside = points(2.0**number)
        if number:
            inside = inside[(np.abs(inside) > 2.0 ** (number - 1)).any(axis=1)]
        assert part.sample(inside)[:, -1].any()
        assert_array_equal(part.sample(inside), field.sample(inside))
    assert not field.sample(points(1) + 5).any()


@pytest.mark.parametrize("shells", [1, 2, 3, 4])
def test_a_tree_of_shells_has_the_cells_of_its_field(shells: int) -> None:
    field = some_shelled_field(shells=shells, basis=4)
    tree = build_n3tree(field)
    tree.require_usable()
    assert (tree.resolution, tree.shells) == (64 << (shells - 1), shells)
    inside = points(2.0 ** (shells - 1))
    assert_array_equal(tree.sample(inside), field.sample(inside))
    assert_array_equal(nerfbake.build_field(tree).sample(inside), field.sample(inside))


def test_a_tree_of_shells_without_cells_is_empty_there() -> None:
    field = some_shelled_field()
    keep = field.top.copy()
    keep[16:24] = -1  # the second shell has none, and the third only some
    held = keep >= 0
    rows = field.rows[field.top[held]]
    numbers, rows_of = np.unique(rows[rows >= 0] >> 1, return_inverse=True)
    rows = rows.copy()
    rows[rows >= 0] = rows_of << 1 | rows[rows >= 0] & 1
    left = replace(field, top=top_grid(held), rows=rows, values=field.values[numbers])
    left.require_usable()
    inside = points(4)
    assert_array_equal(build_n3tree(left).sample(inside), left.sample(inside))


def test_the_inner_cube_of_a_tree_is_the_tree_of_the_first_shell() -> None:
    field = some_shelled_field()
    inner, alone = build_n3tree(field).inner_cube(), build_n3tree(field.shell(0))
    inner.require_usable()
    assert inner.shells == 1
    assert inner.resolution == alone.resolution
    assert_allclose([inner.offset, inner.invradius], [alone.offset, alone.invradius])
    inside = points(1)
    assert_array_equal(inner.sample(inside), alone.sample(inside))
    assert alone.inner_cube() is alone


def test_an_octree_of_a_field_with_shells_is_that_of_its_inner_cube() -> None:
    field = some_shelled_field()
    assert_array_equal(build_octree_from_bricks(field).node_data, build_octree_from_bricks(field.shell(0)).node_data)


def test_shells_must_not_overlap_and_need_room() -> None:
    field = some_shelled_field(shells=2)
    held = field.top >= 0
    held[8 + 3, 3, 3] = True
    extra = int(top_grid(held)[8 + 3, 3, 3])
    rows = np.insert(field.rows, extra, field.rows[0], axis=0)
    with pytest.raises(InvalidScene, match="top has a brick of a shell in a smaller shell"):
        replace(field, top=top_grid(held), rows=rows).require_usable()
    with pytest.raises(InvalidScene, match=r"the field's shells are 2 in 16\^3; allowed: 1 to 8, and 1 in a lattice"):
        replace(field, resolution=16, top=np.full((4, 2, 2), -2, np.int32), rows=field.rows[:0])


def test_a_file_keeps_the_shells(tmp_path: Path) -> None:
    path = tmp_path / "a.npz"
    tree = build_n3tree(some_shelled_field())
    nerfbake.save(path, tree)
    read = nerfbake.load(path, N3Tree)
    assert read.shells == 3
    assert "PlenOctree of 64^3 with 2 shells around it" in str(read)
    assert_array_equal(read.sample(points(4)), tree.sample(points(4)))


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.int64(0), "shells are 0; allowed: 1 to 8"),
        (np.int64(9), "shells are 9; allowed: 1 to 8"),
        (np.float64(2), "shells is 2.0; allowed: a number of shells"),
        (np.array("many"), "shells is many; allowed: a number of shells"),
        (np.int64(8), "shells are 8 in 7 levels; allowed: fewer than its levels"),
    ],
)
def test_shells_of_a_hostile_file_are_one_line(tmp_path: Path, value: Any, message: str) -> None:
    path = tmp_path / "a.npz"
    nerfbake.save(path, build_n3tree(some_shelled_field(shells=2)))
    with np.load(path) as archive:
        arrays = dict(archive)
    np.savez(path, **(arrays | {"shells": value}))
    with pytest.raises((InvalidFile, InvalidScene), match=message):
        nerfbake.load(path, N3Tree).require_usable()


def test_info_names_the_inner_box() -> None:
    tree = build_n3tree(some_shelled_field())
    told = summarise_scene(tree)
    assert told["shells"] == 3
    assert_allclose(told["inner_box"], BOX)
    assert_allclose(told["world_box"], 4 * BOX)
    assert summarise_scene(tree.inner_cube())["inner_box"] is None
