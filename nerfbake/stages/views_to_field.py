"""Posed pictures -> the radiance field that is fitted to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING

import numpy as np

from nerfbake import memory
from nerfbake.device.fit import Losses
from nerfbake.errors import DeviceError, InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Floats, Ints, Points, Singles
from nerfbake.kernels.fit.bricks import round_cells
from nerfbake.kernels.fit.plan import BrickPlan, divide_plan, double_plan, plan_of_kept
from nerfbake.kernels.fit.ties import Ties
from nerfbake.kernels.fit.update import LearningRates
from nerfbake.kernels.march.sh import band_of
from nerfbake.kernels.maths.elementary import exp, log, power
from nerfbake.kernels.picture.metrics import decibels
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.schedule import Rates, Schedule, Stage
from nerfbake.scene.views import Views
from nerfbake.stages._bricks import cells_of_plan, cells_of_solid
from nerfbake.stages._depth_map import DepthMap
from nerfbake.stages._fit_devices import Look, Visit, fit_device
from nerfbake.stages._fit_state import GAINS, FitState, coefficients
from nerfbake.stages._scenery import close_wall, focus_distance, follow_depths, resolved, start_scenery, wall_of
from nerfbake.stages._scenery_depths import find_depths
from nerfbake.stages._scenery_wall import settle_wall
from nerfbake.stages.views_to_hull import find_solid, require_views

if TYPE_CHECKING:
    from nerfbake.device.gpu import Gpu

__all__ = ["FitState", "continue_fit", "fit_field", "measure_state"]

_ALPHA, _ROUGH_ALPHA = 0.5, 0.1  # weights of the loss of alpha: exact, and of rough masks
_POINT = 0.08  # weight of the loss of each cell's own colour
_PARTS = (1.0, 0.4, 0.2, 0.1, 0.05)  # step size of each SH band: the part that all views share is fitted first
_RIDGE = (0.0, 0.004, 0.008, 0.012, 0.016)  # regularisation of the coefficients of each band towards 0
_STEP, _DENSITY_STEP = 1 / 8, 1 / 16  # of rounded coefficients; of rounded densities per cell width
_COVERED = (1 / 16, 1 / 64, 1 / 256)  # pixels of a view; a cell that covers fewer has twice the step for each of these
_START_DENSITY = 0.03  # per cell width, in the visual hull: thicker fog hides the colours behind it
# Weights of the distortion loss. Scenery has it in all stages. An object has it, for distances in cells, only in the
# stages with the schedule's full resolution: with larger cells, a wrong surface could win and hide the right one. So
# scenery has more of it in the last stage, which makes surfaces sharp.
_DISTORTION, _LAST_DISTORTION, _OBJECT_DISTORTION = 0.0025, 0.01, 0.0002
# Weight of the depth loss: where neighbouring pictures show how far a surface is, light must come from there.
_DEPTH = 0.1
# Residuals above this count less in pictures with scenery or rough masks: what only one view shows, such as a person
# who walks by or a mistake of a mask, must not change the others.
_MOST = 0.2
# In the stages with an object's smallest cells, residuals count less where their mean over neighbouring pixels is above
# this: a reflection that only few views show, and that coefficients cannot represent, must not change the others.
_MOST_MEAN = 0.05
# After each epoch, cells are tied to their neighbours (docs/tuning.md): the coefficients of each band, and densities.
# Objects have tied coefficients until cells are divided. A neighbour whose density differs by an edge counts half.
_TIES, _OBJECT_TIES = (0.01, 0.3, 0.3, 0.3, 0.3), (0.003, 0.09, 0.09, 0.09, 0.09)
_DENSITY_TIE, _EDGE = 0.01, 0.03
# In all epochs but the last, the four rays of a pixel are turned to the one and to the other side, to (3, 1) eighths of
# a pixel from its middle: a fit to the same places in each epoch is worse between them.
_TILT = 0.5
# The logarithm of a gain loses so much at each visit. Without this, gains move away from the exposures of photographs:
# the more, the longer a fit takes, and views that were not fitted have no such gains (docs/tuning.md).
_DRIFT = 0.01
_FEW = 32  # most views with scenery whose depths also decide about finer cells (docs/tuning.md)
_RING = 1  # width in pixels of the ring around an object that is fitted, too


def fit_field(
    views: Views,
    *,
    schedule: Schedule,
    basis: str = "SH9",
    box: Points | None = None,
    seed: int = 0,
    exposure: bool = False,
    start: FitState | None = None,
    gpu: Gpu | None = None,
) -> Iterator[FitState]:
    """Fit a field to pictures. Yields the state of the fit after every picture, or after a few on a graphics device.

    Each yield returns the same object.

    The schedule sets the number of rays per pixel for each stage, and the field is best for pictures with the same
    number: 2 x 2 rays for photographs. box: as in carve_hull(); for views with scenery, the inner cube, which is None
    or around what the cameras look at. exposure: also fit a gain for each view and channel, whose geometric mean over
    the views is 1. start: a state to resume from; basis, box, seed and exposure are then those of the state, and the
    schedule must equal the state's. The same arguments give the same bytes, for any number of threads, and also
    if the fit is interrupted and resumed. Raises InvalidScene, MemoryLimit.

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
    state = start or _started(views, schedule, basis, box, seed, exposure)
    state.device = fit_device(gpu)
    if state.schedule != schedule:
        raise InvalidScene(Problem("the state's schedule", f"is {state.schedule}", str(schedule)))
    if state.view >= len(views.pictures):
        raise InvalidScene(
            Problem("the state's view", f"is {state.view}", f"below {len(views.pictures)}, as many as views")
        )
    if len(state.gains) not in (0, len(views.pictures)):
        raise InvalidScene(
            Problem("the state's gains", f"are {len(state.gains)}", f"{len(views.pictures)}, one per view")
        )
    try:
        for _ in continue_fit(state, views):
            if state.done:
                _finish(state, views)
            yield state
    except DeviceError:
        state.return_to_cpu()
        raise


def continue_fit(
    state: FitState,
    views: Views,
    *,
    point: float = _POINT,
    distortion: float = _OBJECT_DISTORTION,
    most_mean: float = _MOST_MEAN,
    tilt: float = _TILT,
    ties: bool = True,
) -> Iterator[FitState]:
    """Take the steps that are left in the state's schedule. Yields the state after every picture, always the same one.

    point: weight of the loss of each cell's own colour. distortion: of the distortion loss of an object in the stages
    with its smallest cells, for places that are measured in cells. most_mean: the largest mean residual of neighbouring
    pixels that counts in full, in the same stages. tilt: of the rays of a pixel, to one side and to the other, see
    pinhole_directions(); in the last epoch they have none. ties: after each epoch but the last, pull the values of
    cells towards those of their neighbours. Raises InvalidScene, MemoryLimit.
    """
    ring = None if views.scenery or views.rough else _RING  # rough masks leave cells outside the object
    if views.scenery and state.depths is None:
        with memory.scope():
            state.depths = find_depths(views, focus_distance(views, state.box))
    depths = {} if state.depths is None else state.depths.maps
    state.device.begin(views, depths, _looks(state, len(views.pictures), ring, tilt))
    losses = Losses(focus_distance(views, state.box), point, distortion, most_mean=most_mean, alpha=_alpha(views))
    while not state.done:
        if state.built < state.stage:
            _rebuild(state, views, depths)
        _visit(state, views, losses)
        if state.view == 0:
            state.device.rest()  # the state may be measured now
            if ties and not state.done:
                state.device.tie(state.cells, _ties(state, scenery=views.scenery))
        yield state


def measure_state(state: FitState, views: Views, *, samples: int) -> float:
    """Return the mean PSNR in dB over views, rendered from the cells of the fit as they are.

    samples: rays along each edge of a pixel. Unlike measure_views(), this needs no field, and no more memory than a
    step of the fit: colours are those in the direction of each cell's centre. Raises MemoryLimit, DeviceError.
    """
    losses = Losses(focus_distance(views, state.box))
    errors = state.device.measure(views, state.cells, samples, losses)
    return sum(map(decibels, errors)) / len(errors)


def _started(views: Views, schedule: Schedule, basis: str, box: Points | None, seed: int, exposure: bool) -> FitState:
    kind = parse_basis(basis)
    if kind.kind != "SH":
        raise InvalidScene(Problem("basis", f"is {basis}", "SH1, SH4, SH9, SH16, SH25"))
    gains = np.ones((len(views.pictures) if exposure else 0, 3))
    B = coefficients(schedule, kind, 0)
    if views.scenery:
        start = start_scenery(views, box, schedule[0].cells, B)
        return FitState(schedule, kind, seed, start.box, start.cells, gains=gains, depths=start.depths)
    solid, box = find_solid(views, box, schedule[0].cells)
    cells = cells_of_solid(solid, box, B, _START_DENSITY, smooth=schedule.smooth > 0)
    return FitState(schedule, kind, seed, box, cells, gains=gains)


def _ties(state: FitState, *, scenery: bool) -> Ties:
    """Return how strongly the cells are tied to their neighbours after an epoch."""
    bands = _TIES if scenery else _OBJECT_TIES
    tied = scenery or not state.divided
    return Ties(np.array(bands, np.float32)[band_of(state.cells.B)] if tied else None, _DENSITY_TIE, _EDGE)


def _rebuild(state: FitState, views: Views, depths: Mapping[int, DepthMap]) -> None:
    """Build the cells of the next stage."""
    bricks, B = state.cells.bricks, coefficients(state.schedule, state.basis, state.stage)
    smooth = bricks.smooth and state.stage < state.schedule.smooth
    state.read_back()
    # The plan has no name here, so its memory is free before the values are copied.
    cells = cells_of_plan(bricks, _next_plan(state, views), state.box, B, smooth=smooth)
    if views.scenery:
        doubled = state.schedule[state.stage].cells > state.schedule[state.stage - 1].cells
        if doubled and len(views.pictures) <= _FEW:
            cells = follow_depths(cells, depths.values(), state.box)
        close_wall(cells)
    state.replace_cells(cells)


def _next_plan(state: FitState, views: Views) -> BrickPlan:
    """Prune cells with low weights, then double the resolution or divide cells."""
    stage, last, bricks = state.schedule[state.stage], state.schedule[state.stage - 1], state.cells.bricks
    keep = _visible(state, last, views)
    plan, wide = plan_of_kept(bricks.top, bricks.slots, bricks.first, keep), bool(state.divided)
    if stage.cells > last.cells:
        plan = double_plan(plan, np.ones(len(keep), bool))
    if stage.split:
        chosen = _most_blamed(state, keep & (resolved(state.cells, views) if views.scenery else True), stage.split)
        plan = divide_plan(plan, chosen) if wide else double_plan(plan, chosen)
        state.divided = 1
    return plan


def _visible(state: FitState, stage: Stage, views: Views) -> Bits:
    """Return (n,) bool: the cells that are kept after the stage. Raises InvalidScene if there are none."""
    keep = state.cells.seen[:, 0] >= stage.prune
    if views.scenery:
        keep |= wall_of(state.cells)
    if not keep.any():
        raise InvalidScene(Problem("the fit", "has no cell left that is visible in a picture", "pictures of an object"))
    return keep


def _most_blamed(state: FitState, keep: Bits, share: float) -> Bits:
    """Return (n,) bool: this share of the kept cells, those with the largest blame; narrow cells are excluded."""
    blame = np.where(keep, state.cells.seen[:, 1], np.float32(-1))
    if state.divided:
        blame[state.cells.bricks.places & 1 == 0] = -1
    return _largest(blame, int(share * np.count_nonzero(keep))) & (blame >= 0)


def _largest(values: Singles, count: int) -> Bits:
    """Return (n,) bool: the `count` largest values; the first ones of those that are equal."""
    if not count:
        return np.zeros(len(values), bool)
    least = np.partition(values, -count)[-count]  # 4 million take 0.02 s, and 0.8 s to sort
    chosen = np.asarray(values > least)
    chosen[np.flatnonzero(values == least)[: count - np.count_nonzero(chosen)]] = True
    return chosen


def _looks(state: FitState, views: int, ring: int | None, tilt: float) -> Iterator[Look]:
    """Yield the looks at the pictures from the state's position to the end of its schedule."""
    schedule, seed, begin = state.schedule, state.seed, (state.stage, state.epoch, state.view)
    for number, stage in enumerate(schedule):
        for epoch in range(stage.epochs):
            order, again = _order(seed, number, epoch, views), epoch + 1 < stage.epochs
            last = number + 1 == len(schedule) and not again
            own = 0.0 if last else -tilt if epoch % 2 else tilt
            for place in range(views):
                if (number, epoch, place) >= begin:
                    yield Look(int(order[place]), stage.scale, stage.rays, ring, again, own)


def _order(seed: int, stage: int, epoch: int, views: int) -> Ints:
    """Return the order in which an epoch visits the views."""
    return np.random.default_rng([seed, stage, epoch]).permutation(views)


def _visit(state: FitState, views: Views, losses: Losses) -> None:
    """Render the pixels of the next views, update the cells, and count on."""
    stage, count, gains = state.schedule[state.stage], len(views.pictures), len(state.gains) > 0
    order = _order(state.seed, state.stage, state.epoch, count)
    if views.scenery:
        last = state.stage + 1 == len(state.schedule)
        losses = losses._replace(distortion=_LAST_DISTORTION if last else _DISTORTION, depth=_DEPTH)
    elif stage.cells < state.schedule.resolution:
        losses = losses._replace(distortion=0.0, most_mean=np.inf)
    else:
        # The loss measures places in distances to the middle of the box.
        cells_away = losses.focus * stage.cells / float((state.box[1] - state.box[0]).mean())
        losses = losses._replace(distortion=losses.distortion * cells_away)
    if views.scenery or views.rough:
        losses = losses._replace(most=_MOST, most_mean=np.inf)
    parts, ridge = (np.array(each, np.float32)[band_of(state.cells.B)] for each in (_PARTS, _RIDGE))
    visits = []
    for place in range(state.view, min(state.view + state.device.size(steady=gains), count)):
        part = (state.epoch * count + place) / max(stage.epochs * count - 1, 1)
        rates = _rate(stage.density, part), _rate(stage.colour, part)
        steps, view = LearningRates(*rates, parts, ridge, float(stage.rays**2)), int(order[place])
        visits.append(Visit(losses, state.gains[view] if gains else None, steps, fresh=place == 0))
    adapts = gains and state.stage > 0
    sums = state.device.visit(state.cells, visits, counted=adapts)
    for place, own in enumerate(sums, start=state.view):
        if adapts:
            _adapt_gains(state, int(order[place]), own)
    _count_on(state, len(visits), count)


def _adapt_gains(state: FitState, view: int, sums: Floats) -> None:
    """Fit the gains of a view to its colours, and scale those of all views so that their geometric mean is 1.

    Those nearer to 1 than _DRIFT are 1, and others are pulled towards it by as much.
    """
    if not (sums[1:] > 0).all():
        return
    gains = state.gains.copy()
    wanted = log(gains[view] * sums[1:4] / sums[4:])
    gains[view] = exp(np.sign(wanted) * np.maximum(np.abs(wanted) - _DRIFT, 0))
    state.gains = np.clip(gains / exp(log(gains).mean(axis=0)), *GAINS)


def _finish(state: FitState, views: Views) -> None:
    """Prune the cells after the last stage, and round their values, so that files are smaller."""
    state.read_back()
    bricks, covered = state.cells.bricks, state.cells.means[:, 1]
    if views.scenery:
        settle_wall(state.cells, views, state.box, state.gains)
    else:
        keep = _visible(state, state.schedule[-1], views)
        state.cells = cells_of_plan(
            bricks, plan_of_kept(bricks.top, bricks.slots, bricks.first, keep), state.box, state.cells.B
        )
        bricks, covered = state.cells.bricks, covered[keep]
    # The square of a rounding error counts in each pixel that the cell covers.
    doubled = np.array([covered < most for most in _COVERED]).sum(axis=0, dtype=np.int32)
    round_cells(bricks.values, bricks.first, np.ldexp(np.float32(_STEP), doubled), _DENSITY_STEP)


def _rate(rates: Rates, part: float) -> float:
    """Interpolate geometrically between the first and the last rate."""
    return rates[0] * float(power(rates[1] / rates[0], part))


def _alpha(views: Views) -> float:
    """Return the weight of the loss of alpha."""
    if not views.masked or views.scenery:
        return 0.0
    return _ROUGH_ALPHA if views.rough else _ALPHA


def _count_on(state: FitState, visits: int, views: int) -> None:
    state.view += visits
    if state.view == views:
        state.view, state.epoch = 0, state.epoch + 1
    if state.epoch == state.schedule[state.stage].epochs:
        state.epoch, state.stage = 0, state.stage + 1
