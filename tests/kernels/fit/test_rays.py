"""What rays ask of cells, against differences: a step in a cell must change the error as its sums say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake.kernels.fit.bricks import (
    COLOUR_SUM,
    CURVATURE,
    DENSITY_SUM,
    MOST,
    ROW,
    SIGMA,
    WEIGHT,
    BrickGrid,
    new_batch,
    no_corners,
)
from nerfbake.kernels.fit.corners import corner_rows, find_corners
from nerfbake.kernels.fit.plan import number_cells, plan_of_solid
from nerfbake.kernels.fit.rays import SUMS, FitView, march_view

EYE = np.array([0.4, 0.3, 5.0])


def bricks(seed: int = 0) -> BrickGrid:
    """A ball of 16^3 cells over the unit cube, with colours of SH4 and densities of all sizes."""
    x = (np.arange(16) + 0.5) / 16 - 0.5
    solid = np.add.outer(np.add.outer(x * x, x * x), x * x) < 0.2
    made, random = number_cells(plan_of_solid(solid)), np.random.default_rng(seed)
    n = len(made.row)
    values = random.normal(0, 1, 13 * n).astype(np.float32)
    for brick in range(len(made.first) - 1):
        start, end = made.first[brick], made.first[brick + 1]
        values[13 * start + 12 * (end - start) : 13 * end] = random.uniform(0, 0.5, end - start)
    size = np.full((1, 3), 1 / 16)
    low, width = np.zeros((1, 3)), np.array([1 / 16])
    return BrickGrid(made.top, made.slots, made.first, made.places, values, low, size, width, no_corners())


def smooth_bricks(seed: int = 0) -> BrickGrid:
    """The same ball with interpolated densities: raw ones on both sides of 1."""
    made = bricks()
    corners = find_corners(made.top, made.first, made.places)
    corners.raw[:] = np.random.default_rng(seed).uniform(-3, 1.5, len(corners.raw))
    return made._replace(corners=corners)


def rays(samples: int) -> Any:
    points = np.stack(np.meshgrid(*[(np.arange(8 * samples) + 0.5) / 8 / samples] * 2, indexing="ij"), axis=-1)
    points = points.reshape(8, samples, 8, samples, 2).transpose(0, 2, 1, 3, 4).reshape(-1, 2)
    directions = np.concatenate([points, np.full((len(points), 1), 0.5)], axis=1) - EYE
    directions /= np.sqrt((directions**2).sum(axis=1, keepdims=True))
    targets = np.random.default_rng(1).uniform(0, 1, (64, 4))
    return directions.astype(np.float32), targets.astype(np.float32)


def view_of(directions: Any, targets: Any, point: float = 0.0) -> FitView:
    white, unknown = np.ones(3, np.float32), np.zeros(0, np.float32)
    return FitView(EYE, directions, targets, white, 0.0, point, 0.0, 1.0, np.inf, np.inf, 0.0, unknown)


def marched(made: BrickGrid, samples: int = 1, tasks: int = 1, point: float = 0.0) -> Any:
    """The errors' sum; the rows (n, 16) added up over tasks; and the sums of all corners, in the same way."""
    directions, targets = rays(samples)
    n, sums, corners = len(made.places), np.zeros((tasks, SUMS)), made.corners
    batch = new_batch(tasks, len(made.slots), n + len(corners.entries) // 2)
    march_view(made, batch, view_of(directions, targets, point), sums)
    assert batch.used.max() <= batch.rows.shape[1]
    total, asked = np.zeros((n, ROW)), np.zeros(len(corners.raw))
    for task in range(tasks):
        for brick, base in enumerate(batch.base[task]):
            if base < 0:
                continue
            start, end = made.first[brick], made.first[brick + 1]
            total[start:end] += batch.rows[task, base : base + end - start]
            if made.smooth:
                after = base + end - start + corner_rows(made, brick)
                entries = corners.entries[corners.first[brick] : corners.first[brick + 1]]
                np.add.at(asked, entries, batch.rows[task, after:].reshape(-1)[: len(entries)])
    return sums[:, 0].sum(), total, asked


def place_of(made: BrickGrid, cell: int) -> int:
    """Where a cell's density stands among the values."""
    brick = int(np.searchsorted(made.first, cell, side="right")) - 1
    start, count = int(made.first[brick]), int(made.first[brick + 1] - made.first[brick])
    return 13 * start + 12 * count + cell - start


@pytest.mark.parametrize("samples", [1, 2])
def test_sums_of_densities_are_the_slope_of_the_error(samples: int) -> None:
    made = bricks()
    _, rows, _ = marched(made, samples)
    cells = np.argsort(-np.abs(rows[:, DENSITY_SUM]))[:20]
    for cell in cells:
        values, errors = made.values.copy(), []
        for step in (-1e-2, 1e-2):
            values[place_of(made, cell)] = made.values[place_of(made, cell)] + step
            errors.append(marched(made._replace(values=values), samples)[0])
        slope = (errors[1] - errors[0]) / 2e-2 * made.width
        # The error falls as fast as the sum says: it holds minus half the slope, over all the rays of a pixel.
        assert_allclose(rows[cell, DENSITY_SUM] / samples**2, -slope / 2, rtol=0.02, atol=1e-5)


@pytest.mark.parametrize("samples", [1, 2])
def test_sums_of_corners_are_the_slope_of_the_error(samples: int) -> None:
    made = smooth_bricks()
    _, _, asked = marched(made, samples)
    for corner in np.argsort(-np.abs(asked))[:20]:
        raw, errors = made.corners.raw.copy(), []
        for step in (-1e-2, 1e-2):
            raw[corner] = made.corners.raw[corner] + step
            errors.append(marched(made._replace(corners=made.corners._replace(raw=raw)), samples)[0])
        assert_allclose(asked[corner] / samples**2, -(errors[1] - errors[0]) / 2e-2 / 2, rtol=0.02, atol=1e-5)


def test_equal_corners_look_like_constant_densities() -> None:
    """A raw density of 1 or above is the density per width itself."""
    made, smooth = bricks(), smooth_bricks()
    smooth.corners.raw[:] = 1.25
    for cell in range(len(made.places)):
        made.values[place_of(made, cell)] = 1.25
    assert_allclose(marched(smooth)[0], marched(made)[0], rtol=1e-6)


@pytest.mark.parametrize("make", [bricks, smooth_bricks], ids=["constant", "interpolated"])
def test_tasks_share_a_view_without_changing_it(make: Callable[[], BrickGrid]) -> None:
    made = make()
    one, many = marched(made, 2, 1, 0.1), marched(made, 2, 5, 0.1)
    assert_allclose(one[0], many[0], rtol=1e-6)
    for column in (COLOUR_SUM, WEIGHT, DENSITY_SUM, CURVATURE):
        assert_allclose(one[1][:, column], many[1][:, column], rtol=1e-4, atol=1e-6)
    assert_allclose(one[2], many[2], rtol=1e-4, atol=1e-6)


def test_weights_of_a_ray_are_at_most_one() -> None:
    _, rows, _ = marched(bricks())
    assert 0 < rows[:, MOST].max() <= 1
    assert rows[:, WEIGHT].sum() <= 64 * 1.0001


def test_a_batch_without_room_says_how_much_it_lacks() -> None:
    made = bricks()
    directions, targets = rays(1)
    batch = new_batch(1, len(made.slots), 100)
    march_view(made, batch, view_of(directions, targets), np.zeros((1, SUMS)))
    _, rows, _ = marched(made)
    assert 100 < batch.used[0] <= len(made.places)
    assert batch.used[0] >= np.count_nonzero(rows[:, SIGMA])
