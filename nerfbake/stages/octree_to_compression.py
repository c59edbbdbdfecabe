"""Octree -> the whole numbers of a file that is as small, or as good, as was asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.errors import BudgetMissed, InvalidScene, Problem
from nerfbake.kernels.march.cells import EMPTY, with_rows
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.scene.compression import Compression
from nerfbake.scene.held_out import HeldOut
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.quantised_octree import QuantisedOctree
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages._coefficients import Coefficients, Rows, transform, visible_leaves
from nerfbake.stages._loss import Cost, Judge, measuring_judge, predicting_judge
from nerfbake.stages.field_to_importance import Importance, weigh_leaves
from nerfbake.stages.octree_to_field import field_of_octree
from nerfbake.stages.octree_to_octree import lower_basis, require_lower
from nerfbake.stages.octree_to_quantised import by_importance, most_important
from nerfbake.stages.scene_to_cameras import sphere_cameras, without_strays

STEPS = (1e-4, 16.0)  # what is tried
# Cameras that importance is collected from, and their pixels along an edge for octrees of up to so many voxels an axis.
# Finer octrees need more pixels, or no ray hits most of their leaves: 10 % fewer bytes at 512^3 for the same loss.
_FRAMES, _EDGE, _VOXELS = 64, 200, 256
_PRUNED = 0.12  # of the squared error that is allowed may come from leaves that are left out
_MOST_PRUNED, _HALVINGS = 0.95, 7
_NEAR_LOSS, _NEAR_SIZE = 0.97, 0.96  # of what is allowed: near enough
_SIZE_SLOPE = 0.8  # of the logarithm of bytes, falling with that of the step
_TRIALS, _SHARES = 16, 4  # at most; and after how many the share that goes stays, so that sizes fall with the step
_AIM, _STRIDE = 0.985, 2.0  # of what is allowed; of a step's logarithm where only one side is known
_WEIGHED, _SHARED = 0.15, 0.5  # of the work is done when the leaves are weighed, and when their share is found
_USUAL = 3  # trials
_FIRST = 22.0  # steps for the root of the squared error that is allowed: of the real chair


def compress_octree(
    octree: SparseVoxelOctree,
    *,
    coded_size: Callable[[QuantisedOctree], int],
    max_loss: float | None = None,
    max_size: int | None = None,
    step: float | None = None,
    basis: str | None = None,
    held_out: HeldOut | None = None,
    source_psnr: float = 35.0,
    field: RadianceField | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Compression:
    """The octree with as few leaves and as coarse a step as one of these allows:

    max_loss  dB against photographs, above 0
    max_size  bytes, as coded_size() finds them; never exceeded, and at least 95 % of it used where quality rises.
              Together with max_loss: the loss is exceeded where it would take more bytes
    step      of colour, as it is; only which leaves are left out is searched

    basis: SHk of a lower degree, whose cost is part of the loss. Leaves are left out while that makes an eighth of the
    squared error. The loss is measured on held_out, pixels of photographs, or else predicted for a source of
    source_psnr (Judge). field: build_field() of the octree, if the caller has it. tell() gets a line for each trial.
    Raises InvalidScene for what cannot be shown, BudgetMissed where the goal is out of reach, MemoryLimit.

    >>> from nerfbake import build_octree, compress_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=16))
    >>> found = compress_octree(octree, coded_size=lambda quantised: quantised.m, max_loss=0.5)
    >>> found.loss <= 0.5, found.measured
    (True, False)
    """
    if (step is None) == (max_loss is None and max_size is None):
        raise InvalidScene(Problem("the goal", "is not one", "max_loss, max_size or both of them, or step"))
    if basis is not None:
        require_lower(octree, basis)  # before the work, not after it
    rows = visible_leaves(octree)
    own = field_of_octree(octree) if field is None else field
    with progress.part(0, _WEIGHED):
        importance = weigh_leaves(own, sphere_cameras(without_strays(own), frames=_FRAMES, edge=_edge(octree)))
    tell(f"{len(rows):,} leaves weighed")
    with progress.listening(None):
        if held_out is not None:
            judge = measuring_judge(own, held_out)
        else:
            judge = predicting_judge(own, source_psnr=source_psnr)
    if basis is not None:
        octree = lower_basis(octree, basis, importance.gram)
        own, size = field_of_octree(octree), octree.data_dim // 3
        importance = importance._replace(gram=importance.gram[:size, :size])
    search = _Search(octree, own, rows, importance, judge, coded_size, tell)
    if max_loss is not None:
        found = search.within_loss(max_loss, max_size)
    elif max_size is not None:
        found = search.within_size(max_size)
    else:
        assert step is not None
        found = search.at_step(step)
    memory.kept(found.quantised)
    return found


class _Tried(NamedTuple):
    """What came of a step and a share of leaves that were left out."""

    step: float
    share: float
    size: int
    error: float

    @classmethod
    def of(cls, made: Compression) -> _Tried:
        return cls(made.quantised.colour_step, made.pruned, made.size, made.error)


class _Search:
    """Trials of a share of leaves that are left out and a step; the best that is allowed is kept."""

    def __init__(
        self,
        octree: SparseVoxelOctree,
        own: RadianceField,
        rows: Rows,
        importance: Importance,
        judge: Judge,
        coded_size: Callable[[QuantisedOctree], int],
        tell: Callable[[str], None],
    ) -> None:
        self._octree, self._own, self._rows = octree, own, rows
        self._gram, self._order = importance.gram, by_importance(importance)
        self._judge, self._coded_size, self._tell = judge, coded_size, tell
        # The squared error by share: what a lower basis costs is there from the first.
        with progress.listening(None):
            self._pruning = {0.0: judge.cost(own).error}
        self._trials = 0
        self._coefficients: tuple[float, Coefficients] | None = None  # of this share

    # -- the three goals ---------------------------------------------------------------------------------------
    def within_loss(self, most: float, size: int | None) -> Compression:
        allowed = self._judge.allowed_error(most)
        allowed = max(allowed - self._pruning[0.0], 0.01 * allowed)
        share, step = self._share_for(_PRUNED * allowed), _FIRST * float(np.sqrt(allowed))
        best: Compression | None = None
        made: Compression | None = None
        points: list[tuple[float, float]] = []
        for _ in range(_TRIALS):
            made = None  # unless it is the best, its memory is needed
            made = self._trial(share, step)
            points.append((step, made.loss / most))
            if made.loss <= most and (best is None or made.size < best.size):
                best = made
            if size is not None and made.size > size and made.loss >= _NEAR_LOSS * most:
                near, made, best = _Tried.of(made), None, None  # whose leaves would be in the way
                return self.within_size(size, near)
            if best is not None and best.loss >= _NEAR_LOSS * most:
                break
            step = next_step(points, slope=2.0)
            if step == points[-1][0]:
                break
        found = best or made
        assert found is not None
        if size is not None and found.size > size:
            return self.within_size(size, _Tried.of(found))
        found.require(most)
        return found

    def within_size(self, most: int, near: _Tried | None = None) -> Compression:
        """near: what was tried before, which is too large."""
        share, step = 0.0, _FIRST * float(np.sqrt(self._judge.allowed_error(0.1)))
        if near is not None:
            step = near.step * (near.size / most) ** (1 / _SIZE_SLOPE)
            share = self._share_for_rounding(near, step)
        best: Compression | None = None
        made: Compression | None = None
        points: list[tuple[float, float]] = []
        for count in range(_TRIALS):
            made = None
            made = self._trial(share, step)
            points.append((step, made.size / most))
            if made.size <= most and (best is None or made.loss < best.loss):
                best = made
            if best is not None and best.size >= _NEAR_SIZE * most:
                break
            step = next_step(points, slope=-_SIZE_SLOPE)
            if step == points[-1][0]:
                break
            if count < _SHARES:
                share = self._share_for_rounding(_Tried.of(made), step)
                points = points if share == made.pruned else points[-1:]
        if best is None:
            assert made is not None
            raise BudgetMissed(Problem("the octree", f"takes {made.size:,} bytes at the least", f"`max_size={most:,}`"))
        return best

    def at_step(self, step: float) -> Compression:
        whole = self._trial(0.0, step)
        rounding = whole.error - self._pruning[0.0]
        share = self._share_for(_PRUNED / (1 - _PRUNED) * max(rounding, 0.0))
        return self._trial(share, step) if share else whole

    # -- parts of a trial --------------------------------------------------------------------------------------
    def _trial(self, share: float, step: float) -> Compression:
        self._trials += 1
        begin = _SHARED if len(self._pruning) > 1 else _WEIGHED
        with progress.part(_done(self._trials - 1, begin), _done(self._trials, begin)):
            return self._tried(share, step)

    def _tried(self, share: float, step: float) -> Compression:
        keep = most_important(self._order, share)
        if self._coefficients is None or self._coefficients[0] != share:
            self._coefficients = None  # lets go of the old ones before there are new ones
            self._coefficients = share, transform(self._octree, self._rows[keep], self._gram)
        quantised = self._coefficients[1].rounded(step)
        cost, size = self._cost(keep, quantised.leaf_values()), self._coded_size(quantised)
        judge = self._judge
        self._tell(f"step {step:.4g}, {100 * share:.1f} % pruned: {size:,} bytes, {cost.loss:.3f} dB")
        measured = judge.truth is not None
        return Compression(quantised, share, size, *cost, measured, judge.source_psnr, judge.views)

    def _share_for_rounding(self, near: _Tried, step: float) -> float:
        """The share for another step, given what was lost with one."""
        rounding = max(near.error - self._pruning[near.share], 0.0) * (step / near.step) ** 2
        return self._share_for(_PRUNED / (1 - _PRUNED) * rounding)

    def _share_for(self, allowed: float) -> float:
        """The largest share that adds no more than this squared error, by halving; the error rises with the share."""
        low, high = 0.0, _MOST_PRUNED
        allowed += self._pruning[low]
        for _ in self._halvings():
            middle = (low + high) / 2
            if middle not in self._pruning:
                keep = most_important(self._order, middle)
                self._pruning[middle] = self._cost(keep, self._own.values[keep]).error
            low, high = (middle, high) if self._pruning[middle] <= allowed else (low, middle)
        return low

    def _halvings(self) -> Iterator[int]:
        """The rounds that find the first share are a step of their own; later ones know most of the errors."""
        first = len(self._pruning) == 1 and not self._trials
        with progress.part(_WEIGHED, _SHARED) if first else progress.listening(None):
            yield from progress.each(range(_HALVINGS))

    def _cost(self, keep: Rows, values: npt.NDArray[np.float32]) -> Cost:
        """Of the field with only these leaves, which hold these values."""
        own = self._own
        slot = np.full(len(own.values), EMPTY, np.int32)
        slot[keep] = np.where(values[:, -1] > 0, -2 - np.arange(len(keep)), EMPTY)
        return self._judge.cost(replace(own, cells=with_rows(own.cells, slot), values=values))


def _edge(octree: SparseVoxelOctree) -> int:
    """Pixels along an edge, in proportion to the octree's voxels, up to four times _EDGE."""
    return _EDGE * min(max(_VOXELS, *octree.size), 4 * _VOXELS) // _VOXELS


def _done(trials: int, begin: float) -> float:
    """The share of the work that is done after so many trials: nobody knows how many there will be."""
    return begin + (1 - begin) * trials / (trials + max(1, _USUAL - trials))


def next_step(points: list[tuple[float, float]], *, slope: float) -> float:
    """The step to try next, from (step, what was found over what is allowed) of all that were tried.

    A little on the allowed side of 1, on a line in logarithms: between the nearest two steps around it, else with this
    slope from the nearest; within STEPS.
    """
    sign = 1.0 if slope > 0 else -1.0
    known = sorted((step, sign * float(log(max(value, 1e-6) / _AIM))) for step, value in points)
    below = [point for point in known if point[1] < 0]
    above = [point for point in known if point[1] >= 0]
    if below and above:
        (a, low), (b, high) = below[-1], above[0]
        part = min(max(-low / (high - low), 0.1), 0.9)
        return a * float(exp(part * float(log(b / a))))
    step, value = below[-1] if below else above[0]
    grown = step * float(exp(min(max(-value / abs(slope), -_STRIDE), _STRIDE)))
    return min(max(grown, STEPS[0]), STEPS[1])
