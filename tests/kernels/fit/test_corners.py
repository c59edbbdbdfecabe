"""Corners of cells: each one once, the same densities in finer cells, and steps to what their cells ask for."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.arrays import Bits, Floats, Points, Singles
from nerfbake.kernels.fit.bricks import BrickGrid, no_corners, values_by_cell
from nerfbake.kernels.fit.corners import (
    LEAST_RAW,
    density_of_raw,
    fill_densities,
    find_corners,
    raw_of_density,
    refine_corners,
)
from nerfbake.kernels.fit.plan import BrickPlan, divide_plan, double_plan, number_cells, plan_of_kept, plan_of_solid
from nerfbake.kernels.fit.update import step_corners
from nerfbake.stages._bricks import cell_places

RANDOM = np.random.default_rng(0)
SPARSE: Bits = RANDOM.random((16, 16, 16)) < 0.2


def grid_of(plan: BrickPlan, *, smooth: bool) -> tuple[BrickGrid, npt.NDArray[np.int32]]:
    """Bricks of SH1 over the unit cube, and the source row of each cell."""
    made = number_cells(plan)
    R = 8 * made.top.shape[1]
    corners = find_corners(made.top, made.first, made.places) if smooth else no_corners()
    values, size = np.zeros(4 * len(made.row), np.float32), np.full((1, 3), 1 / R)
    low, width = np.zeros((1, 3)), np.array([1 / R])
    return BrickGrid(made.top, made.slots, made.first, made.places, values, low, size, width, corners), made.row


def corner_places(bricks: BrickGrid) -> Points:
    """The place (m, 3) of each corner in the unit cube."""
    _, lowest = cell_places(bricks)
    brick = np.repeat(np.arange(len(bricks.slots)), np.diff(bricks.first))
    entries = bricks.corners.first[brick][:, None] + bricks.corners.of_cell
    found = np.full((len(bricks.corners.raw), 3), np.nan)
    for corner in range(8):
        at = lowest + np.array([corner >> 2, corner >> 1 & 1, corner & 1])
        found[bricks.corners.entries[entries[:, corner]]] = at * bricks.size[0]
    return found


def densities(bricks: BrickGrid) -> Singles:
    rows = np.empty((len(bricks.places), 4), np.float32)
    values_by_cell(bricks.values, bricks.first, rows)
    return rows[:, 3]


def slanted(places: Points) -> Floats:
    return np.asarray(2 + places @ np.array([1.0, 2.0, 3.0]))


@pytest.mark.parametrize("solid", [np.ones((16, 16, 16), bool), SPARSE], ids=["full", "sparse"])
def test_every_corner_is_there_once(solid: Bits) -> None:
    bricks, _ = grid_of(plan_of_solid(solid), smooth=True)
    touched = np.zeros((17, 17, 17), bool)
    for corner in range(8):
        x, y, z = corner >> 2, corner >> 1 & 1, corner & 1
        touched[x : x + 16, y : y + 16, z : z + 16] |= solid
    assert_array_equal(np.argwhere(touched), np.rint(16 * corner_places(bricks)))


def test_every_entry_leads_to_its_corner_and_back() -> None:
    corners = grid_of(plan_of_solid(SPARSE), smooth=True)[0].corners
    owner = np.repeat(np.arange(len(corners.raw)), np.diff(corners.back_first))
    assert_array_equal(corners.entries[corners.back], owner)
    assert_array_equal(np.sort(corners.back), np.arange(len(corners.entries)))


def test_shells_have_no_corner_in_common() -> None:
    solid = np.zeros((32, 16, 16), bool)
    solid[15], solid[16] = True, True  # the end of the first shell, and the start of the second
    bricks, _ = grid_of(plan_of_solid(solid), smooth=True)
    assert len(bricks.corners.raw) == 2 * 2 * 17 * 17


@pytest.mark.parametrize("density", [0.03, 0.5, 1.0, 2.5])
def test_a_density_comes_back_from_its_raw_one(density: float) -> None:
    found, slope = density_of_raw(float(raw_of_density(density)))
    assert found == pytest.approx(density, rel=1e-6)
    assert slope == pytest.approx(min(density, 1), rel=1e-6)


def test_finer_cells_have_the_same_densities() -> None:
    old, _ = grid_of(plan_of_solid(SPARSE), smooth=True)
    old.corners.raw[:] = slanted(corner_places(old))
    plan = plan_of_kept(old.top, old.slots, old.first, np.ones(len(old.places), bool))
    new, rows = grid_of(double_plan(plan, np.ones(len(old.places), bool)), smooth=True)
    refine_corners(rows, old, new)
    assert_allclose(new.corners.raw, slanted(corner_places(new)) / 2, rtol=1e-5)  # per width, which is half as large


def test_cells_take_the_densities_at_their_places() -> None:
    old, _ = grid_of(plan_of_solid(SPARSE), smooth=True)
    old.corners.raw[:] = slanted(corner_places(old))
    n = len(old.places)
    fill_densities(np.arange(n, dtype=np.int32), old, old)
    _, lowest = cell_places(old)
    assert_allclose(densities(old), slanted((lowest + 0.5) / 16), rtol=1e-6)

    plan = plan_of_kept(old.top, old.slots, old.first, np.ones(len(old.places), bool))
    twice = double_plan(plan, RANDOM.random(n) < 0.5)
    for finer in (twice, divide_plan(twice, RANDOM.random(n) < 0.5)):
        new, rows = grid_of(finer, smooth=False)
        fill_densities(rows, old, new)
        _, lowest = cell_places(new)
        width = 1 + (new.places & 1)
        expected = slanted((lowest + width[:, None] / 2) / 32) * width / 2
        assert_allclose(densities(new), expected, rtol=1e-5)


def test_steps_add_up_what_bricks_ask_for() -> None:
    corners = grid_of(plan_of_solid(np.ones((16, 16, 16), bool)), smooth=True)[0].corners
    corners.raw[:] = 1.0
    shared = int(np.argmax(np.diff(corners.back_first)))
    entries = corners.back[corners.back_first[shared] : corners.back_first[shared + 1]]
    assert len(entries) == 8  # the middle of eight bricks
    corners.asked[entries], corners.curvature[entries] = 0.5, 1.0
    step_corners(corners, 0.1)
    assert corners.raw[shared] == pytest.approx(1 + 4 * 0.1 * 0.5, rel=1e-3)
    assert np.count_nonzero(corners.raw != 1) == 1
    assert not corners.asked.any()
    assert not corners.curvature.any()
    corners.asked[entries], corners.curvature[entries] = -1e6, 1.0
    for _ in range(200):
        corners.asked[entries], corners.curvature[entries] = -1e6, 1.0
        step_corners(corners, 0.1)
    assert corners.raw[shared] == np.float32(LEAST_RAW)
