from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.errors import InvalidScene
from nerfbake.scene.basis import guess_data_format, parse_basis
from nerfbake.scene.n3tree import N3Tree
from tests.support.scenes import n3tree


def test_sampling_by_hand() -> None:
    tree = n3tree(splits=[(0, (1, 0, 1))])
    assert_array_equal(tree.sample([0.1, 0.1, 0.1]), tree.data[0, 0, 0, 0])
    assert_array_equal(tree.sample([0.6, 0.1, 0.9]), tree.data[1, 0, 0, 1])
    # On a boundary, and a rounding below it: the upper cell.
    assert_array_equal(tree.sample([0.5, 0.5, 0.5]), tree.data[0, 1, 1, 1])
    assert_array_equal(tree.sample([0.5 - 1e-16, 0.5 - 1e-13, 0.5]), tree.data[0, 1, 1, 1])
    assert_array_equal(tree.sample([0.5 - 1e-9, 0.5, 0.5]), tree.data[0, 0, 1, 1])
    assert_array_equal(tree.sample([[1.0, 0, 0], [-0.1, 0, 0], [np.nan, 0, 0], [0, np.inf, 0]]), 0)


def test_sampling_is_in_world_coordinates() -> None:
    tree = n3tree(offset=np.array([0.5, 0.25, 0]), invradius=np.array([0.25, 0.5, 2]))
    # p = world * invradius + offset
    assert_array_equal(tree.sample([-1.9, 1.4, 0.4]), tree.data[0, 0, 1, 1])


def test_empty_leaves_read_as_zeros() -> None:
    tree = n3tree()
    tree.data[0, 1, 1, 1, -1] = 0
    tree.data[0, 0, 0, 0, -1] = -3
    assert_array_equal(tree.sample([[0.9, 0.9, 0.9], [0.1, 0.1, 0.1]]), 0)


def test_points_of_any_shape() -> None:
    tree = n3tree()
    assert tree.sample(np.zeros((2, 5, 3))).shape == (2, 5, 4)
    assert tree.sample(np.zeros((0, 3))).shape == (0, 4)
    with pytest.raises(InvalidScene, match="points have shape"):
        tree.sample(np.zeros((3, 2)))


def rewired(cell: tuple[int, int, int, int], offset: int) -> N3Tree:
    """Three nodes: 0 -> 1 at (0, 0, 0), 1 -> 2 at (1, 1, 1), and one cell changed."""
    tree = n3tree(splits=[(0, (0, 0, 0)), (1, (1, 1, 1))])
    tree.child[cell] = offset
    return tree


@pytest.mark.parametrize(
    ("cell", "offset", "message"),
    [
        ((1, 1, 1, 1), -1, "child[1, 1, 1, 1] points to node 0"),
        ((2, 0, 0, 1), -1, "child[2, 0, 0, 1] points to node 1; allowed: 0 (no child)"),
        ((2, 0, 0, 1), -2, "child[2, 0, 0, 1] points to node 0"),
        ((0, 1, 0, 0), 99, "child[0, 1, 0, 0] points to node 99; allowed: 0 (no child), a node of 1 to 2"),
        ((0, 1, 0, 0), 2, "points to node 2, as another cell does"),
        ((0, 1, 0, 0), 1, "child[0, 1, 0, 0] points to node 1, as another cell does"),
        ((1, 0, 0, 0), -2147483648, "child[1, 0, 0, 0] points to node -2147483647"),
        ((1, 0, 0, 0), 2147483647, "child[1, 0, 0, 0] points to node 2147483648"),
    ],
)
def test_a_table_that_is_no_tree_is_refused(cell: tuple[int, int, int, int], offset: int, message: str) -> None:
    tree = rewired(cell, offset)
    assert message in "\n".join(map(str, tree.problems()))
    with pytest.raises(InvalidScene, match="child"):
        tree.sample([0.5, 0.5, 0.5])


def test_a_chain_of_nodes_ends_at_the_deepest_level_there_can_be() -> None:
    n = 100_000
    child = np.zeros((n, 2, 2, 2), np.int32)
    child[:-1, 1, 0, 1] = 1
    tree = N3Tree(child, np.zeros((n, 2, 2, 2, 4), np.float16), np.zeros(3), np.ones(3), "SH1")
    assert "leads to level 20; allowed: levels 0 to 19" in str(tree.problems()[0])


def test_freed_rows_and_stale_cells_do_not_count() -> None:
    tree = rewired((1, 1, 1, 1), 0)  # node 2 is now pointed at by nothing
    tree.child[2] = -1
    tree.data[2] = np.nan
    tree.data[0, 0, 0, 0] = -np.inf  # has a child
    assert tree.problems() == []
    assert [rows.tolist() for rows in tree.levels] == [[0], [1]]


def test_every_wrong_value_is_named() -> None:
    tree = n3tree()
    tree.data[0, 0, 1, 0, 2] = np.nan
    tree.data[0, 1, 0, 0, :2] = np.inf
    tree.data[0, 1, 1, 1, -1] = -2
    assert [str(problem) for problem in tree.problems()] == [
        "data[0, 0, 1, 0, 2] is nan; allowed: a finite number (and 2 more)",
        "data[0, 1, 1, 1, 3] is -2; allowed: a density of 0 or more (`svo --sigma-min 0` reads less as empty)",
    ]
    tree = n3tree(invradius=np.array([1, 0, np.nan]), offset=np.array([0, np.inf, 0]))
    assert [str(problem) for problem in tree.problems()] == [
        "invradius[1] is 0; allowed: a finite number above 0, 1e-15 to 1e+15 (and 1 more)",
        "offset[1] is inf; allowed: a finite number, up to 1e+15",
    ]


@pytest.mark.parametrize(
    "wrong",
    [
        {"child": np.zeros((0, 2, 2, 2), np.int32), "data": np.zeros((0, 2, 2, 2, 4), np.float16)},
        {"child": np.zeros((1, 1, 1, 1), np.int32), "data": np.zeros((1, 1, 1, 1, 4), np.float16)},
        {"child": np.zeros((1, 2, 2, 3), np.int32)},
        {"child": np.zeros((1, 2, 2, 2), np.int64)},
        {"data": np.zeros((1, 2, 2, 2, 3), np.float16)},
        {"data": np.zeros((2, 2, 2, 2, 4), np.float16)},
        {"data": np.zeros((1, 2, 2, 2, 4), np.float64)},
        {"data_format": "SH9"},
        {"data_format": "SH2"},
        {"data_format": "nonsense"},
    ],
)
def test_shapes_are_checked(wrong: dict[str, object]) -> None:
    with pytest.raises(InvalidScene, match="allowed"):
        replace(n3tree(), **wrong)  # type: ignore[arg-type]


def test_bases() -> None:
    assert [parse_basis(name).data_dim for name in ("SH1", "SH25", "RGBA", "SG25", "ASG8")] == [4, 76, 4, 76, 25]
    assert [guess_data_format(dim) for dim in (4, 28, 49, 76, 13, 1, 6)] == [
        "RGBA",
        "SH9",
        "SH16",
        "SH25",
        "SH4",
        "",
        "",
    ]
