"""The passes of a fit on a software device, against the kernels of the CPU."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.device.fit import DeviceVisit, FitPasses, Losses, Pixels
from nerfbake.device.gpu import Gpu
from nerfbake.errors import DeviceError
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.fit.bricks import BrickGrid, new_batch
from nerfbake.kernels.fit.colours import number_pixels, pinhole_directions, tile_order
from nerfbake.kernels.fit.rays import SUMS, FitView, march_view
from nerfbake.kernels.fit.ties import Ties
from nerfbake.kernels.fit.update import LearningRates, take_steps
from nerfbake.kernels.march.sh import band_of
from nerfbake.stages._bricks import BrickCells, with_corners
from nerfbake.stages._fit_devices import CpuFit
from tests.kernels.fit import test_ties as of_ties
from tests.kernels.fit.test_rays import bricks, smooth_bricks

EDGE, SAMPLES, TILT, BACKGROUND = 24, 2, 0.5, (1.0, 0.9, 0.8)
OPTICS = 2.0 * EDGE, 2.0 * EDGE, EDGE / 2, EDGE / 2
PARTS, RIDGE = (np.array(each, np.float32)[band_of(4)] for each in ((1.0, 0.4), (0.0, 0.004)))
STEPS = LearningRates(0.1, 0.4, PARTS, RIDGE, float(SAMPLES**2))


def pixels(seed: int) -> Pixels:
    """All pixels of a camera that looks at the ball, with random targets that 16 bits can express."""
    random = np.random.default_rng(seed)
    back = random.normal(size=3)
    back /= np.sqrt((back**2).sum())
    right = np.cross([0.1, 0.2, 0.97], back)
    right /= np.sqrt((right**2).sum())
    numbers = np.empty(EDGE * EDGE, np.int32)
    number_pixels(np.ones((EDGE, EDGE), bool), tile_order(EDGE, EDGE), numbers)
    targets = random.integers(0, 65536, (len(numbers), 4)).astype(np.float32) / np.float32(65535)
    targets[::3, 3] = 1
    turn = np.stack([right, np.cross(back, right), back], axis=1)
    distances = random.uniform(1.5, 3.5, len(numbers)).astype(np.float32) * (random.random(len(numbers)) < 0.7)
    return Pixels(numbers, targets, 0.5 + 2.5 * back, turn, OPTICS, EDGE, BACKGROUND, distances)


class OnCpu:
    """The cells of a fit, which the kernels change."""

    def __init__(self, grid: BrickGrid) -> None:
        self.grid = grid
        self.means, self.seen = (np.zeros((len(grid.places), 2), np.float32) for _ in range(2))

    def visit(self, view: Pixels, losses: Losses, gains: Any) -> Any:
        directions = np.empty((len(view.numbers) * SAMPLES**2, 3), np.float32)
        pinhole_directions(view.numbers, EDGE, np.array(OPTICS), view.turn, SAMPLES, TILT, directions)
        targets, background = view.targets.copy(), np.array(BACKGROUND, np.float32)
        ground = (1 - targets[:, 3:]) * background
        targets[:, :3] = (targets[:, :3] - ground) / gains.astype(np.float32) + ground
        batch, sums = new_batch(1, len(self.grid.slots), 16384), np.zeros((1, SUMS))
        weights = losses.alpha, losses.point, losses.distortion, losses.focus, losses.most, losses.most_mean
        own = FitView(view.eye, directions, targets, background, *weights, losses.depth, view.distances)
        march_view(self.grid, batch, own, sums)
        take_steps(self.grid, batch, view.eye, self.means, self.seen, STEPS)
        return sums.sum(axis=0)


def visited(gpu: Gpu, make: Callable[[], BrickGrid], views: int, losses: Losses, gains: Any) -> tuple[OnCpu, OnCpu]:
    """The cells after visits on the CPU and on the device; their sums over the pictures are compared here."""
    own, theirs, passes = OnCpu(make()), OnCpu(make()), FitPasses(gpu)
    passes.upload(theirs.grid, theirs.means, theirs.seen)
    for seed in range(views):
        view = pixels(seed)
        uploaded = passes.upload_view(view)._replace(tilt=TILT)
        visit = DeviceVisit(uploaded, SAMPLES, losses, gains, STEPS, seed == 0)
        sums = own.visit(view, losses, gains)
        assert_allclose(passes.visit([visit], counted=True)[0], sums, rtol=1e-5 if views == 1 else 1e-3)
    passes.read_back(theirs.grid, theirs.means, theirs.seen)
    return own, theirs


@pytest.mark.long
@pytest.mark.parametrize("make", [bricks, smooth_bricks])
@pytest.mark.parametrize(
    ("losses", "gains"),
    [
        (Losses(2.5, 0.08, alpha=0.5), (1.0, 1.0, 1.0)),
        (Losses(2.5, 0.08, distortion=0.3), (1.0, 1.0, 1.0)),
        (Losses(2.5, 0.08, distortion=0.01, depth=0.5), (1.0, 1.0, 1.0)),
        (Losses(2.5, 0.0, most=0.3, alpha=0.1), (1.2, 0.9, 0.8)),
    ],
)
def test_one_view(gpu: Gpu, make: Callable[[], BrickGrid], losses: Losses, gains: Any) -> None:
    own, theirs = visited(gpu, make, 1, losses, np.array(gains))
    assert_allclose(theirs.means, own.means, rtol=1e-3, atol=2e-5)
    assert_allclose(theirs.seen, own.seen, rtol=1e-3, atol=2e-5)
    # Steps of a clipped quotient: those of cells that hardly any light reaches have few digits.
    values, before = own.grid.values, make().values
    assert np.abs(values - before).max() > 0.5
    assert_allclose(theirs.grid.values, values, atol=5e-3)
    assert np.abs(theirs.grid.values - values).mean() < 1e-4
    if own.grid.smooth:
        raw = own.grid.corners.raw
        assert np.abs(raw - make().corners.raw).max() > 0.3
        assert_allclose(theirs.grid.corners.raw, raw, atol=0.02)
        assert np.abs(theirs.grid.corners.raw - raw).mean() < 1e-3


@pytest.mark.long
@pytest.mark.parametrize("make", [bricks, smooth_bricks])
def test_five_views(gpu: Gpu, make: Callable[[], BrickGrid]) -> None:
    own, theirs = visited(gpu, make, 5, Losses(2.5, 0.08, alpha=0.5), np.ones(3))
    assert np.abs(theirs.grid.values - own.grid.values).mean() < 1e-3
    assert_allclose(theirs.grid.values, own.grid.values, atol=0.05)
    assert_allclose(theirs.seen, own.seen, rtol=0.01, atol=0.002)


@pytest.mark.long
def test_neighbours_with_a_large_mean_residual_count_less(gpu: Gpu) -> None:
    # The mean is over other pixels than on the CPU, so only its effect is compared: the blame.
    means = [visited(gpu, bricks, 1, Losses(2.5, 0.08, most_mean=most), np.ones(3)) for most in (np.inf, 0.02)]
    (_, full), (own, theirs) = means
    assert theirs.seen[:, 1].sum() < 0.7 * full.seen[:, 1].sum()
    assert theirs.seen[:, 1].sum() == pytest.approx(own.seen[:, 1].sum(), rel=0.25)


@pytest.mark.long
def test_sums_are_coarser_where_many_rays_meet_a_cell_and_the_steps_are_the_same(gpu: Gpu) -> None:
    grid, passes = bricks(), FitPasses(gpu)
    means = np.zeros((len(grid.places), 2), np.float32)
    passes.upload(grid, means, means.copy())
    view = pixels(0)
    cells = passes._held()
    unit = [
        passes._steps_a_unit(
            cells,
            DeviceVisit(
                passes.upload_view(view._replace(optics=(f, f, 12.0, 12.0))), 2, Losses(2.5), np.ones(3), STEPS
            ),
        )
        for f in (20.0, 2000.0)
    ]
    assert unit[0] == 2**20 > unit[1]
    numbers = np.resize(view.numbers, 2_000_000)
    targets, distances = np.resize(view.targets, (2_000_000, 4)), np.zeros(0, np.float32)
    inside = view._replace(eye=np.array([0.5, 0.5, 0.5]), numbers=numbers, targets=targets, distances=distances)
    with pytest.raises(DeviceError, match=r"a cell may meet 8,000,000 rays of a view; allowed: 131,072"):
        passes._steps_a_unit(cells, DeviceVisit(passes.upload_view(inside), 2, Losses(2.5), np.ones(3), STEPS))


def tied(gpu: Gpu, cells: BrickCells, ties: Ties) -> Singles:
    """The values of cells after a tie on the device. The arrays of the cells stay."""
    passes, found = FitPasses(gpu), cells.bricks._replace(values=cells.bricks.values.copy())
    passes.upload(found, cells.means, cells.seen)
    passes.tie(ties)
    passes.read_back(found, cells.means.copy(), cells.seen.copy())
    return found.values


TIES = Ties(of_ties.STRENGTHS, of_ties.STRENGTH, of_ties.EDGE)


@pytest.mark.parametrize("parts", [1, 3])
@pytest.mark.parametrize(("shells", "split"), [(1, False), (3, False), (1, True)])
@pytest.mark.parametrize("ties", [TIES, TIES._replace(coefficients=None)])
def test_cells_are_tied_as_on_the_cpu_and_to_the_same_bytes_on_every_run(
    gpu: Gpu, monkeypatch: pytest.MonkeyPatch, parts: int, shells: int, split: bool, ties: Ties
) -> None:
    cells = of_ties.random_cells(np.random.default_rng(1), shells=shells, split=split)
    bounds = [round(len(cells.bricks.slots) * part / parts) for part in range(parts + 1)]
    monkeypatch.setattr(FitPasses, "_ranges", lambda *_: pairwise(bounds))
    before, found = cells.bricks.values.copy(), tied(gpu, cells, ties)
    assert_array_equal(tied(gpu, cells, ties), found)
    CpuFit().tie(cells, ties)
    assert np.abs(cells.bricks.values - before).max() > 0.1
    assert_allclose(found, cells.bricks.values, rtol=0, atol=2e-6)


@pytest.mark.parametrize("ties", [TIES, TIES._replace(coefficients=None)])
def test_ties_leave_interpolated_densities(gpu: Gpu, ties: Ties) -> None:
    cells = with_corners(of_ties.random_cells(np.random.default_rng(1), split=True))
    before, found = of_ties.rows(cells), tied(gpu, cells, ties)
    CpuFit().tie(cells, ties)
    assert_allclose(found, cells.bricks.values, rtol=0, atol=2e-6)
    cells.bricks.values[:] = found
    assert_array_equal(of_ties.rows(cells)[:, -1], before[:, -1])


def test_a_stage_that_a_binding_cannot_hold_is_one_line(gpu: Gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    grid, passes = bricks(), FitPasses(gpu)
    means: Singles = np.zeros((len(grid.places), 2), np.float32)
    monkeypatch.setattr(gpu, "limits", gpu.limits._replace(binding=40_000))
    with pytest.raises(DeviceError, match=r"the sums of [\d,]+ cells needs a buffer of .*; allowed: .* on llvmpipe"):
        passes.upload(grid, means, means)


def test_values_that_are_not_numbers_are_not_read(gpu: Gpu) -> None:
    grid, passes = bricks(), FitPasses(gpu)
    grid.values[-1] = np.nan
    means, seen = (np.zeros((len(grid.places), 2), np.float32) for _ in range(2))
    passes.upload(grid, means, seen)
    for array in (grid.values, means, seen):
        array[:] = 7
    with pytest.raises(DeviceError, match="the values are not numbers"):
        passes.read_back(grid, means, seen)
    assert all((array == 7).all() for array in (grid.values, means, seen))
