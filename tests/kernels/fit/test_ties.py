"""Ties between neighbouring cells, against the same formula over a dense grid."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.arrays import Bits, Singles
from nerfbake.kernels.fit.bricks import values_by_brick, values_by_cell
from nerfbake.kernels.fit.plan import double_plan, plan_of_kept
from nerfbake.kernels.fit.ties import tie_coefficients, tie_densities
from nerfbake.stages._bricks import BrickCells, cell_places, cells_of_plan, cells_of_solid

BOX = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
STRENGTHS = np.array([0.1, 0.5, 0.5, 0.5], np.float32)
STRENGTH, EDGE = 0.2, 0.3  # of the densities
D = 13


def random_cells(rng: np.random.Generator, *, shells: int = 1, split: bool = False) -> BrickCells:
    solid: Bits = rng.random((16 * shells, 16, 16)) < 0.3
    cells = cells_of_solid(solid, BOX, 4)
    if split:
        bricks = cells.bricks
        plan = plan_of_kept(bricks.top, bricks.slots, bricks.first, np.ones(cells.n, bool))
        cells = cells_of_plan(bricks, double_plan(plan, rng.random(cells.n) < 0.5), BOX, 4)
    put(cells, rng.random((cells.n, D), np.float32))
    cells.means[:] = rng.random((cells.n, 2)) * (rng.random((cells.n, 2)) < 0.8)  # some were never hit
    return cells


def tie(cells: BrickCells) -> None:
    tie_coefficients(cells.bricks, cells.means, STRENGTHS)
    tie_densities(cells.bricks, cells.means, STRENGTH, EDGE)


def rows(cells: BrickCells) -> Singles:
    found = np.empty((cells.n, D), np.float32)
    values_by_cell(cells.bricks.values, cells.bricks.first, found)
    return found


def put(cells: BrickCells, values: Singles) -> None:
    values_by_brick(values, cells.bricks.first, cells.bricks.values)


def tied(cells: BrickCells) -> npt.NDArray[np.float64]:
    """The formula, cell by cell over a dense grid of cell numbers."""
    shell, at = cell_places(cells.bricks)
    wide, R = cells.bricks.places & 1, 8 * cells.bricks.top.shape[1]
    number = np.full((int(shell.max()) + 1, R + 2, R + 2, R + 2), -1)
    for dx, dy, dz in np.ndindex(2, 2, 2):
        filled = (wide == 1) | (dx + dy + dz == 0)
        number[shell[filled], *(at[filled] + [1 + dx, 1 + dy, 1 + dz]).T] = np.flatnonzero(filled)
    before, means = rows(cells).astype(np.float64), cells.means.astype(np.float64)
    before[:, -1] /= 1 + wide
    after = before.copy()
    for cell in range(cells.n):
        steps = [np.eye(3, dtype=int)[axis] * step for axis in range(3) for step in (-1, 1 + wide[cell])]
        near = [number[shell[cell], *(at[cell] + 1 + step)] for step in steps]
        others = np.array([other for other in near if other >= 0], int)
        if not len(others):
            continue
        weight, evidence = means[others, 1], means[cell]
        if weight.sum():
            part = np.tile(STRENGTHS / (STRENGTHS + evidence[1]), 3)
            mean = (weight[:, None] * before[others, :-1]).sum(axis=0) / weight.sum()
            after[cell, :-1] += part * (mean - before[cell, :-1])
        alike = EDGE / (EDGE + np.abs(before[others, -1] - before[cell, -1]))
        tie = STRENGTH * min(alike.sum(), 1)
        mean = (alike * before[others, -1]).sum() / alike.sum()
        after[cell, -1] += tie / (tie + evidence[0]) * (mean - before[cell, -1])
    after[:, -1] *= 1 + wide
    return after


@pytest.mark.parametrize(("shells", "split"), [(1, False), (2, False), (1, True)])
def test_values_follow_the_formula_across_bricks_shells_and_wide_cells(shells: int, split: bool) -> None:
    cells = random_cells(np.random.default_rng(1), shells=shells, split=split)
    expected = tied(cells)
    moved = np.abs(expected - rows(cells)).max(axis=0)
    assert (moved > 0.1).all(), "the formula moves every value of some cell"
    tie(cells)
    assert_allclose(rows(cells), expected, atol=2e-6)


def test_a_cell_that_no_picture_shows_takes_the_mean_of_its_neighbours() -> None:
    solid = np.zeros((16, 16, 16), bool)
    solid[7:10, 8, 8] = True  # three in a row, across the border of two bricks
    cells = cells_of_solid(solid, BOX, 4)
    values = np.repeat(np.array([[1.0], [5.0], [2.0]], np.float32), D, axis=1)
    values[:, -1] = 0.4, 0.5, 0.6
    put(cells, values)
    cells.means[:] = np.array([[1e9, 3e9], [0.0, 0.0], [1e9, 1e9]])
    tie(cells)
    found = rows(cells)
    assert_allclose(found[1, :-1], (3 * 1 + 2) / 4, rtol=1e-6)
    assert found[1, -1] == pytest.approx(0.5)
    assert_allclose(found[[0, 2]], values[[0, 2]], rtol=1e-6)  # what pictures show well stays


def test_an_edge_of_the_densities_stays() -> None:
    solid = np.zeros((16, 16, 16), bool)
    solid[4:8, 8, 8] = True
    cells = cells_of_solid(solid, BOX, 4)
    values = np.zeros((4, D), np.float32)
    values[:, -1] = 0, 0.001, 5, 5.001
    put(cells, values)
    cells.means[:, 0] = 0.2
    tie(cells)
    # Without an edge, the two cells in the middle would move by 1.2.
    assert_allclose(rows(cells)[:, -1], values[:, -1], atol=0.15)


def test_a_cell_alone_stays() -> None:
    solid = np.zeros((16, 16, 16), bool)
    solid[3, 3, 3] = solid[9:11, 8, 8] = True
    cells = cells_of_solid(solid, BOX, 4)
    values = np.random.default_rng(2).random((3, D), np.float32)
    put(cells, values)
    cells.means[:] = 0.5
    tie(cells)
    alone = (cell_places(cells.bricks)[1] == 3).all(axis=1)
    assert_array_equal(rows(cells)[alone], values[alone])
    assert (rows(cells)[~alone] != values[~alone]).all()


def test_interpolated_densities_are_refused() -> None:
    cells = cells_of_solid(np.ones((16, 16, 16), bool), BOX, 4, smooth=True)
    with pytest.raises(ValueError, match="corners"):
        tie_densities(cells.bricks, cells.means, STRENGTH, EDGE)
