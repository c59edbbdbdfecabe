"""Sparse voxel octree -> quantised octree, with given parameters or with parameters found for a loss or a file size."""

from __future__ import annotations

from collections.abc import Callable
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
from nerfbake.stages.coefficients import STEPS, Coefficients, Rows, transform, visible_leaves
from nerfbake.stages.field_to_importance import Importance, weigh_leaves
from nerfbake.stages.loss import SOURCE_PSNR, Loss, LossMeter, measuring_judge, predicting_judge
from nerfbake.stages.octree_to_octree import lower_basis, require_lower
from nerfbake.stages.renderers import KERNELS, Renderer
from nerfbake.stages.scene_to_cameras import scatter_cameras, without_strays
from nerfbake.stages.scene_to_field import build_field_from_octree


def quantise_octree(
    octree: SparseVoxelOctree, importance: Importance, *, step: float, prune: float = 0.0
) -> QuantisedOctree:
    """Transform the leaves, and round them to multiples of a step: docs/compression.md, "What is done".

    importance: weigh_leaves() of build_field(octree). prune: share of the leaves to prune, the least important first,
    0 to 1; at least one leaf remains. step: of colour before the sigmoid, as its root mean square over the rays.
    Raises InvalidScene for SG and ASG, for broken octrees and for octrees without visible leaves; MemoryLimit.

    >>> from nerfbake import build_field, build_octree, quantise_octree, sample_n3tree, scatter_cameras, weigh_leaves
    >>> octree = build_octree(sample_n3tree(resolution=16))
    >>> field = build_field(octree)
    >>> importance = weigh_leaves(field, scatter_cameras(field, frames=8, edge=64))
    >>> print(quantise_octree(octree, importance, step=0.1, prune=0.2))
    SH9 octree of 16x16x16, 459 leaves, step 0.1
    """
    if not 0 <= prune <= 1:
        raise InvalidScene(Problem("prune", f"is {prune:g}", "a share of 0 to 1"))
    rows = visible_leaves(octree)
    keep = most_important(by_importance(importance), prune)
    values = octree.leaf_values(rows)
    return memory.kept(transform(octree, rows, values, keep, importance.gram).rounded(step))


def by_importance(importance: Importance) -> Rows:
    """Return the field's leaves in order of importance, the least important first; ties keep their order."""
    return np.argsort(importance.largest, kind="stable")


def most_important(order: Rows, prune: float) -> Rows:
    """Return the leaves that remain if this share is pruned from the start of `order`, in ascending order."""
    stays = np.zeros(len(order), bool)
    stays[order[min(int(prune * len(order)), len(order) - 1) :]] = True
    return np.flatnonzero(stays)


# Importance is computed from _FRAMES cameras with _EDGE pixels along an edge for _VOXELS along an axis. Finer octrees
# need more pixels, or no ray hits most leaves: 10 % fewer bytes at 512^3 for the same loss. Coarser ones need fewer: at
# 128^3, 100 pixels give the same bytes. More than _RAYS in all gain little: twice as many gain 0.01 dB at 1024^3 and
# 4.3 MB, and take 5 s longer.
_FRAMES, _EDGE, _VOXELS, _RAYS = 64, 200, 256, 21_000_000
_COARSEST, _FINEST = 160, 1024  # range of the voxels along an axis, for the number of pixels
_PRUNED, _FACTOR = 0.06, 1.5  # share of the loss that pruning causes, within this factor
_MOST_PRUNED, _FIRST_PRUNED, _PRUNINGS = 0.95, 0.05, 7  # shares of the leaves; number of shares that are tried
_LEAST_LOSS = 0.02  # smaller losses, and gains, are interpolated as this ratio to the allowed loss
_NEAR = 0.96  # the search ends at this fraction of the allowed loss or size
_FAR = 1.5  # the loss is given up early if the size is estimated to exceed the allowed one by this factor
_SLOPE, _PRUNING_SLOPE = 1.7, 1.3  # d log(loss) / d log(step) and / d log(share of pruned leaves)
_TRIALS, _SHARES = 16, 4  # most trials; after _SHARES sizes the share is fixed, so that sizes decrease with the step
_AIM, _STRIDE = 0.985, 2.0  # target as a fraction of what is allowed; largest change of log(step) when extrapolating
_WEIGHED, _SHARED = 0.15, 0.5  # progress when the leaves are weighted, and when the share to prune is found
_USUAL = 3  # usual number of trials
_FIRST = 22.0  # first step / sqrt(allowed squared error), measured on the real chair


def compress_octree(
    octree: SparseVoxelOctree,
    *,
    coded_size: Callable[[QuantisedOctree], int],
    max_loss: float | None = None,
    max_size: int | None = None,
    step: float | None = None,
    basis: str | None = None,
    held_out: HeldOut | None = None,
    source_psnr: float = SOURCE_PSNR,
    field: RadianceField | None = None,
    tell: Callable[[str], None] = lambda text: None,
    render: Renderer = KERNELS,
) -> Compression:
    """Prune and quantise an octree as far as one of these limits allows:

    max_loss  dB of PSNR against photographs, above 0
    max_size  bytes returned by coded_size(); never exceeded, and at least 95 % used if that improves the quality. If
              max_loss is given too and would need more bytes, the loss is exceeded
    step      of colour, used as it is; only the leaves to prune are searched

    basis: SHk of a lower degree; its error is part of the loss. Pruning may cause about 6 % of the loss.
    The loss is measured on held_out, pixels of photographs, or else predicted for a source of source_psnr, with a
    margin. field: build_field() of the octree, if you have already built it. render: renders fields. tell() is called
    with a line of text for each trial.
    Raises InvalidScene for an octree that cannot be rendered, BudgetMissed if the limit cannot be met, MemoryLimit.

    >>> from nerfbake import build_octree, compress_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=16))
    >>> found = compress_octree(octree, coded_size=lambda quantised: quantised.m, max_loss=0.5)
    >>> found.loss <= 0.5, found.measured
    (True, False)
    """
    if (step is None) == (max_loss is None and max_size is None):
        raise InvalidScene(Problem("the goal", "is missing or ambiguous", "max_loss, max_size or both, or else step"))
    if basis is not None:
        require_lower(octree, basis)  # fail before the expensive part
    rows = visible_leaves(octree)
    own = build_field_from_octree(octree) if field is None else field
    with progress.part(0, _WEIGHED):
        edge = _edge(octree)
        frames = min(_FRAMES, _RAYS // edge**2)
        importance = weigh_leaves(own, scatter_cameras(without_strays(own), frames=frames, edge=edge))
    tell(f"{len(rows):,} leaves weighed")
    with progress.listening(None):
        if held_out is not None:
            judge = measuring_judge(own, held_out, render=render)
        else:
            judge = predicting_judge(own, source_psnr=source_psnr, render=render)
    whole = 0.0
    if basis is not None:
        octree = lower_basis(octree, basis, importance.gram)
        own, size = build_field_from_octree(octree), octree.data_dim // 3
        importance = importance._replace(gram=importance.gram[:size, :size])
        whole = judge.cost(own).loss
    search = _Search(octree, own, rows, importance, judge, whole, coded_size, tell)
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
    """The result of a trial: its step, its share of pruned leaves, and their error and loss."""

    step: float
    share: float
    error: float
    loss: float

    def __str__(self) -> str:
        return f"step {self.step:.4g}, {100 * self.share:.1f} % pruned"


class _Search:
    """A search over the share of pruned leaves and the step.

    Only one octree is in memory. Coding it takes longer than a trial, so sizes are estimated first. An octree is coded
    only where its exact size is needed.
    """

    def __init__(
        self,
        octree: SparseVoxelOctree,
        own: RadianceField,
        rows: Rows,
        importance: Importance,
        judge: LossMeter,
        whole: float,
        coded_size: Callable[[QuantisedOctree], int],
        tell: Callable[[str], None],
    ) -> None:
        self._octree, self._own, self._rows = octree, own, rows
        self._gram, self._order = importance.gram, by_importance(importance)
        self._judge, self._coded_size, self._tell = judge, coded_size, tell
        self._pruning = {0.0: whole}  # loss by share, including that of a lower basis
        self._trials = 0
        self._coefficients: tuple[float, Coefficients] | None = None  # of this share
        self._last: tuple[_Tried, QuantisedOctree] | None = None  # of the trial that was coded last
        self._sizes: dict[_Tried, int] = {}

    # -- the three goals ---------------------------------------------------------------------------------------
    def within_loss(self, most: float, size: int | None) -> Compression:
        """Search the smallest octree with a loss of at most `most`, or within_size() if it exceeds `size` bytes."""
        allowed = max(most - self._pruning[0.0], 0.01 * most)
        share = self._share_for(_PRUNED * allowed)
        step = _FIRST * float(np.sqrt(self._judge.allowed_error(allowed)))
        best: _Tried | None = None
        points: list[tuple[float, float]] = []
        for _ in range(_TRIALS):
            tried = self._trial(share, step)
            points.append((step, tried.loss / most))
            if tried.loss <= most and (best is None or tried.step > best.step):
                best = tried
            step = next_step(points, slope=_SLOPE)
            if size is not None and self._transformed(share).estimated_size(step) > _FAR * size:
                return self.within_size(size, tried)
            if best is not None and best.loss >= _NEAR * most:
                break
            if step == points[-1][0]:
                break
        found = best or tried
        if size is not None and self._size(found) > size:
            return self.within_size(size, found)
        made = self._made(found)
        made.require(most)
        return made

    def within_size(self, most: int, near: _Tried | None = None) -> Compression:
        """Search the best octree of at most `most` bytes. near: an earlier trial, which was too large."""
        if near is None:
            near = self._trial(0.0, self._transformed(0.0).step_for_size(_AIM * most))
        best, aim = None, _AIM * most
        points: list[tuple[float, float]] = []  # (step, size / allowed size) of this share
        for count in range(_TRIALS):
            if near in self._sizes:  # corrects the estimate
                size = self._sizes[near]
                points.append((near.step, size / most))
                aim = _AIM * most * self._transformed(near.share).estimated_size(near.step) / size
            share, step = near.share, self._step_for_size(near.share, aim, points)
            if count < _SHARES and (other := self._share_for_rounding(near, step)) != share:
                share, points = other, []
                step = self._step_for_size(share, aim, points)
            if (share, step) != (near.share, near.step):
                near = self._trial(share, step)
            elif near in self._sizes:
                break
            size = self._size(near)
            if size <= most and (best is None or near.loss < best.loss):
                best = near
            if best is not None and self._size(best) >= _NEAR * most:
                break
        if best is None:
            found = f"takes at least {min(self._sizes.values()):,} bytes, and `max_size` is {most:,}"
            raise BudgetMissed(Problem("the octree", found, "a larger `max_size`"))
        return self._made(best)

    def at_step(self, step: float) -> Compression:
        """Quantise with this step; only the share of pruned leaves is searched."""
        whole = self._trial(0.0, step)
        share = self._share_for_rounding(whole, step)
        return self._made(self._trial(share, step) if share else whole)

    # -- parts of a trial --------------------------------------------------------------------------------------
    def _trial(self, share: float, step: float) -> _Tried:
        self._trials += 1
        begin = _SHARED if len(self._pruning) > 1 else _WEIGHED
        with progress.part(_done(self._trials - 1, begin), _done(self._trials, begin)):
            self._last = None  # frees its leaves
            keep, values = most_important(self._order, share), self._transformed(share).leaf_values(step)
            slots = np.where(values[:, -1] > 0, -2 - np.arange(len(keep)), EMPTY)
            tried = _Tried(step, share, *self._cost(keep, slots, values))
        self._tell(f"{tried}: {tried.loss:.3f} dB")
        return tried

    def _transformed(self, share: float) -> Coefficients:
        if self._coefficients is None or self._coefficients[0] != share:
            keep = most_important(self._order, share)
            self._coefficients = self._last = None  # frees the old ones before the new ones are computed
            self._coefficients = share, transform(self._octree, self._rows, self._own.values, keep, self._gram)
        return self._coefficients[1]

    def _quantised(self, tried: _Tried) -> QuantisedOctree:
        if self._last is None or self._last[0] != tried:
            self._last = None  # frees its leaves
            self._last = tried, self._transformed(tried.share).rounded(tried.step)
        return self._last[1]

    def _size(self, tried: _Tried) -> int:
        """Return the size in bytes of a trial's octree."""
        if tried not in self._sizes:
            self._sizes[tried] = self._coded_size(self._quantised(tried))
            self._tell(f"{tried}: {self._sizes[tried]:,} bytes, {tried.loss:.3f} dB")
        return self._sizes[tried]

    def _made(self, tried: _Tried) -> Compression:
        size, judge, measured = self._size(tried), self._judge, self._judge.truth is not None
        octree, pruned = self._quantised(tried), 1 - self._quantised(tried).m / len(self._order)
        expected = tried.loss if measured else judge.expected_loss(tried.error)
        costs = tried.error, tried.loss, expected
        return Compression(octree, pruned, size, *costs, measured, judge.source_psnr, judge.views)

    def _step_for_size(self, share: float, aim: float, points: list[tuple[float, float]]) -> float:
        """Return the step with this estimated size, or one between earlier steps if a file was too large and one not.

        points: (step, size / allowed size) of earlier trials with the same share.
        """
        ratios = [ratio for _, ratio in points]
        if points and min(ratios) < _AIM <= max(ratios):
            return next_step(points, slope=-1.0)
        return self._transformed(share).step_for_size(aim)

    def _share_for_rounding(self, near: _Tried, step: float) -> float:
        """Return the share to prune at another step, from the loss that rounding causes in a trial."""
        rounding = max(near.loss - self._pruning[near.share], 0.0) * (step / near.step) ** _SLOPE
        return self._share_for(_PRUNED / (1 - _PRUNED) * rounding)

    def _share_for(self, allowed: float) -> float:
        """Return a share that adds this loss within _FACTOR, or else the largest one found that adds less."""
        most, whole = _MOST_PRUNED, self._pruning[0.0]
        least = min(1 / len(self._order), most)
        # Progress is shown for the first share only. Later searches find most of their errors in the cache.
        first = len(self._pruning) == 1 and not self._trials
        with progress.part(_WEIGHED, _SHARED) if first else progress.listening(None):
            for _ in progress.each(range(_PRUNINGS if allowed > 0 else 0)):
                losses = [(share, (loss - whole) / allowed) for share, loss in self._pruning.items() if share]
                points = [(share, max(ratio, _LEAST_LOSS)) for share, ratio in losses]
                for share, ratio in points:
                    if 1 / _FACTOR <= ratio <= _FACTOR:
                        return share
                share = next_step(points, slope=_PRUNING_SLOPE, limits=(least, most)) if points else _FIRST_PRUNED
                if share in self._pruning:
                    break
                keep = most_important(self._order, share)
                self._pruning[share] = self._cost(keep, -2 - keep, self._own.values).loss
        return max(share for share, loss in self._pruning.items() if loss - whole <= max(allowed, 0.0))

    def _cost(self, keep: Rows, slots: Rows, values: npt.NDArray[np.float32]) -> Loss:
        """Return the loss of the field with only these leaves, with these slots and values."""
        own = self._own
        slot = np.full(len(own.values), EMPTY, np.int32)
        slot[keep] = slots
        return self._judge.cost(replace(own, cells=with_rows(own.cells, slot), values=values))


def _edge(octree: SparseVoxelOctree) -> int:
    """Return the pixels along an edge, proportional to the octree's voxels along its longest axis."""
    return _EDGE * min(max(_COARSEST, *octree.size), _FINEST) // _VOXELS


def _done(trials: int, begin: float) -> float:
    """Return the progress after a number of trials. It is an estimate, since their total number is unknown."""
    return begin + (1 - begin) * trials / (trials + max(1, _USUAL - trials))


def next_step(points: list[tuple[float, float]], *, slope: float, limits: tuple[float, float] = STEPS) -> float:
    """Return the next step to try, from pairs (step, result / allowed result) of all earlier trials.

    The target is a ratio a little below 1. The step is interpolated on a logarithmic line between the two nearest
    steps on both sides of the target, or extrapolated with this slope from the nearest one. It stays within the limits.
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
    return min(max(grown, limits[0]), limits[1])
