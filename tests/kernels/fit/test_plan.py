from __future__ import annotations

from typing import Any

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake.kernels.fit.plan import (
    BrickPlan,
    FinalBricks,
    divide_plan,
    double_plan,
    number_cells,
    plan_of_kept,
    plan_of_solid,
)


def cells(made: FinalBricks) -> Any:
    """(R, R, R) the number of the row that each place's cell is made of, -1 for none."""
    r = len(made.top)
    found = np.full((8 * r,) * 3, -1)
    for x, y, z in np.argwhere(made.top >= 0):
        brick = made.top[x, y, z]
        slots = made.slots[brick].reshape(8, 8, 8)
        rows = np.where(slots >= 0, made.row[made.first[brick] + np.maximum(slots >> 1, 0)], -1)
        found[8 * x : 8 * x + 8, 8 * y : 8 * y + 8, 8 * z : 8 * z + 8] = rows
    return found


def some(R: int = 16) -> Any:
    return np.random.default_rng(0).random((R, R, R)) < 0.05


def numbered(solid: Any) -> tuple[FinalBricks, Any]:
    """The cells of a solid, each made of a row of its own."""
    first = number_cells(plan_of_solid(solid))
    made = number_cells(plan_of_kept(first.top, first.slots, first.first, np.ones(len(first.row), bool)))
    return made, cells(made)


def test_a_solid_comes_back() -> None:
    made, rows = numbered(some())
    assert_array_equal(rows >= 0, some())
    assert sorted(rows[rows >= 0]) == list(range(len(made.row)))


def test_what_is_not_kept_goes_with_its_brick() -> None:
    made, rows = numbered(some())
    keep = np.zeros(len(made.row), bool)
    keep[rows[:8, :8, :8][some()[:8, :8, :8]]] = True
    left = number_cells(plan_of_kept(made.top, made.slots, made.first, keep))
    assert len(left.slots) == 1
    assert_array_equal(cells(left) >= 0, some() & (np.indices((16,) * 3).max(axis=0) < 8))


def test_twice_as_fine_and_then_divided() -> None:
    made, rows = numbered(some())
    split = np.arange(len(made.row)) % 3 == 0
    plan: BrickPlan = double_plan(plan_of_kept(made.top, made.slots, made.first, np.ones(len(split), bool)), split)
    finer = number_cells(plan)
    fine = cells(finer)
    assert_array_equal(fine, np.repeat(np.repeat(np.repeat(rows, 2, 0), 2, 1), 2, 2))
    assert len(finer.row) == 8 * split.sum() + (~split).sum()
    wide = (finer.places & 1).astype(bool)
    assert_array_equal(split[finer.row], ~wide)
    more = number_cells(divide_plan(plan, np.ones(len(split), bool)))
    assert len(more.row) == 8 * len(split)
    assert_array_equal(cells(more), fine)
