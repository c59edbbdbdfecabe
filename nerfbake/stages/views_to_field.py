"""Posed pictures -> the field that looks like them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Points
from nerfbake.kernels.fit.bricks import ROW, Batch, Bricks, new_batch
from nerfbake.kernels.fit.plan import divided, doubled, plan_of_kept
from nerfbake.kernels.fit.rays import View, march_view
from nerfbake.kernels.fit.update import Steps, take_steps
from nerfbake.kernels.march.sh import band_of
from nerfbake.kernels.maths.elementary import power
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.schedule import Rates, Schedule
from nerfbake.scene.views import Views
from nerfbake.stages._bricks import cells_of_plan, cells_of_solid
from nerfbake.stages._fit_state import FitState
from nerfbake.stages._looks import Looks, looks_of
from nerfbake.stages.views_to_hull import find_solid, require_views

__all__ = ["FitState", "fit_field"]

TASKS = 16  # that a view's pixels are shared out to; more would be no faster on 16 cores, and take more memory
_ALPHA, _POINT = 0.1, 0.08  # weights of the loss of alpha, and of every cell's own colour
_PARTS = (1.0, 0.4, 0.2, 0.1, 0.05)  # of each band in a step: what all views agree on is found first
_RIDGE = (0.0, 0.004, 0.008, 0.012, 0.016)  # pull of the coefficients of each band towards 0
_RING = 1  # pixels around an object that are looked at, too


def fit_field(
    views: Views,
    *,
    schedule: Schedule,
    basis: str = "SH9",
    box: Points | None = None,
    seed: int = 0,
    start: FitState | None = None,
) -> Iterator[FitState]:
    """Fits a field to pictures, and gives its state, always the same object, after every picture.

    The schedule says for each stage how many rays a pixel has, and so for which pictures the field is best: 2 x 2 rays
    for photographs. box: as carve_hull() takes it. start: a state to go on from; then basis, box and seed are its own,
    and the schedule must be. The same arguments give the same bytes, however many threads there are and wherever the
    fit was interrupted. Raises InvalidScene, MemoryLimit.

    Source: Plenoxels (Fridovich-Keil et al., 2022) for the representation and its coarse-to-fine growth; the steps are
    our own (docs/fitting.md, "How it is fitted").

    >>> from nerfbake import Views, build_field, fit_field, orbit_cameras, render_field, sample_n3tree
    >>> from nerfbake.scene.schedule import parse_schedule
    >>> scene = build_field(sample_n3tree(resolution=8))
    >>> cameras = orbit_cameras(scene, frames=4, width=24, height=24)
    >>> pictures = tuple(render_field(scene, camera, background=None).pixels for camera in cameras.cameras)
    >>> views = Views(cameras, pictures, (1.0, 1.0, 1.0), True)
    >>> *_, state = fit_field(views, schedule=parse_schedule("cells=8,epochs=2/cells=16,epochs=2"))
    >>> state.done, state.field().resolution
    (True, 16)
    """
    require_views(views)
    state = start or _started(views, schedule, basis, box, seed)
    if state.schedule != schedule:
        raise InvalidScene(Problem("the state's schedule", f"is {state.schedule}", str(schedule)))
    if state.view >= len(views.pictures):
        raise InvalidScene(
            Problem("the state's view", f"is {state.view}", f"below {len(views.pictures)}, as many as views")
        )
    batch = None
    while not state.done:
        if state.built < state.stage:
            batch = None  # its memory is needed
            _rebuild(state)
        batch = _visit(state, views, batch)
        _count_on(state, len(views.pictures))
        yield state


def _started(views: Views, schedule: Schedule, basis: str, box: Points | None, seed: int) -> FitState:
    kind = parse_basis(basis)
    if kind.kind != "SH":
        raise InvalidScene(Problem("basis", f"is {basis}", "SH1, SH4, SH9, SH16, SH25"))
    solid, box = find_solid(views, box, schedule[0].cells)
    return FitState(schedule, kind, seed, box, cells_of_solid(solid, box, kind.size))


def _rebuild(state: FitState) -> None:
    """The cells of the next stage: those that were seen, twice as many an axis, or some of them divided."""
    stage, last, bricks = state.schedule[state.stage], state.schedule[state.stage - 1], state.cells.bricks
    keep = state.cells.seen[:, 0] >= last.prune
    if not keep.any():
        raise InvalidScene(Problem("the fit", "has no cell left that any picture sees", "pictures of an object"))
    plan, wide = plan_of_kept(bricks.top, bricks.slots, bricks.first, keep), bool(state.divided)
    if stage.cells > last.cells:
        plan = doubled(plan, np.ones(len(keep), bool))
    if stage.split:
        chosen = _most_blamed(state, keep, stage.split)
        plan = divided(plan, chosen) if wide else doubled(plan, chosen)
        state.divided = 1
    state.cells = cells_of_plan(bricks, plan, state.box)
    state.built = state.stage


def _most_blamed(state: FitState, keep: Bits, share: float) -> Bits:
    """(n,) the share of the kept cells that have the largest part in what pictures are off; narrow cells have none."""
    blame = np.where(keep, state.cells.seen[:, 1], np.float32(-1))
    if state.divided:
        blame[state.cells.bricks.places & 1 == 0] = -1
    chosen = np.zeros(len(keep), bool)
    chosen[np.argsort(-blame, kind="stable")[: int(share * np.count_nonzero(keep))]] = True
    return chosen & (blame >= 0)


def _visit(state: FitState, views: Views, batch: Batch | None) -> Batch | None:
    """One view's pixels, and the step that the cells take."""
    stage, cells = state.schedule[state.stage], state.cells
    if state.view == 0:
        cells.seen[:, 1] = 0
        state.error = state.values = 0.0
    order = np.random.default_rng([state.seed, state.stage, state.epoch]).permutation(len(views.pictures))
    looks = looks_of(views, int(order[state.view]), scale=stage.scale, samples=stage.rays, ring=_RING)
    if not len(looks.pixels):
        return batch
    error, batch = _marched(cells.bricks, batch, looks, views)
    state.error += error
    state.values += 3 * len(looks.pixels)
    part = (state.epoch * len(order) + state.view) / max(stage.epochs * len(order) - 1, 1)
    parts, ridge = (np.array(each, np.float32)[band_of(state.basis.size)] for each in (_PARTS, _RIDGE))
    rates = _rate(stage.density, part), _rate(stage.colour, part)
    steps = Steps(*rates, parts, ridge, float(stage.rays**2))
    take_steps(cells.bricks, batch, looks.eye, cells.means, cells.seen, steps)
    return batch


def _rate(rates: Rates, part: float) -> float:
    """Between the first and the last, geometrically."""
    return rates[0] * float(power(rates[1] / rates[0], part))


def _marched(bricks: Bricks, batch: Batch | None, looks: Looks, views: Views) -> tuple[float, Batch]:
    """The sum of squares of what the pixels are off; with a larger batch where the view needs it."""
    background, errors = np.array(views.background, np.float32), np.zeros(TASKS)
    view = View(looks.eye, looks.directions, looks.targets, background, _ALPHA if views.masked else 0.0, _POINT)
    capacity = max(4096, len(bricks.places) // 8)
    while True:
        if batch is None:
            memory.require(f"fitting {len(bricks.places):,} cells", TASKS * capacity * ROW * 4 + 4 * len(bricks.values))
            batch = new_batch(TASKS, len(bricks.slots), capacity)
        march_view(bricks, batch, view, errors)
        capacity = int(batch.used.max())
        if capacity <= batch.rows.shape[1]:
            return float(errors.sum()), batch
        batch, capacity = None, capacity * 5 // 4


def _count_on(state: FitState, views: int) -> None:
    state.view += 1
    if state.view == views:
        state.view, state.epoch = 0, state.epoch + 1
    if state.epoch == state.schedule[state.stage].epochs:
        state.epoch, state.stage = 0, state.stage + 1
