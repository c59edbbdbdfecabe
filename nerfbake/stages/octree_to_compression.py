"""Sparse voxel octree -> quantised octree, with given parameters or with parameters found for a loss or a file size."""

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
from nerfbake.stages._loss import Loss, LossMeter, measuring_judge, predicting_judge
from nerfbake.stages.field_to_importance import Importance, weigh_leaves
from nerfbake.stages.octree_to_octree import lower_basis, require_lower
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


STEPS = (1e-4, 16.0)  # smallest and largest step of the search
# Importance is computed from _FRAMES cameras with _EDGE pixels along an edge, for octrees of up to _VOXELS along an
# axis. Finer octrees need more pixels, or no ray hits most leaves: 10 % fewer bytes at 512^3 for the same loss. More
# than _RAYS in all gain little: twice as many gain 0.01 dB at 1024^3 and 4.3 MB, and take 5 s longer.
_FRAMES, _EDGE, _VOXELS, _RAYS = 64, 200, 256, 21_000_000
_PRUNED = 0.12  # share of the allowed squared error that pruning may cause
_MOST_PRUNED, _HALVINGS = 0.95, 7
_NEAR_LOSS, _NEAR_SIZE = 0.97, 0.96  # the search ends at this fraction of the allowed loss or size
_FAR = 1.5  # the loss is given up early if the size is predicted to exceed the allowed one by this factor
_SIZE_SLOPE = 0.8  # -d log(size) / d log(step)
_TRIALS, _SHARES = 16, 4  # most trials; after _SHARES trials the share is fixed, so that sizes decrease with the step
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
    source_psnr: float = 35.0,
    field: RadianceField | None = None,
    tell: Callable[[str], None] = lambda text: None,
) -> Compression:
    """Prune and quantise an octree as far as one of these limits allows:

    max_loss  dB of PSNR against photographs, above 0
    max_size  bytes returned by coded_size(); never exceeded, and at least 95 % used if that improves the quality. If
              max_loss is given too and would need more bytes, the loss is exceeded
    step      of colour, used as it is; only the leaves to prune are searched

    basis: SHk of a lower degree; its error is part of the loss. Pruning may cause about an eighth of the squared error.
    The loss is measured on held_out, pixels of photographs, or else predicted for a source of source_psnr. field:
    build_field() of the octree, if you have already built it. tell() is called with a line of text for each trial.
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
            judge = measuring_judge(own, held_out)
        else:
            judge = predicting_judge(own, source_psnr=source_psnr)
    if basis is not None:
        octree = lower_basis(octree, basis, importance.gram)
        own, size = build_field_from_octree(octree), octree.data_dim // 3
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
    """The result of a trial: its step, its share of pruned leaves, and their error and loss."""

    step: float
    share: float
    error: float
    loss: float

    def __str__(self) -> str:
        return f"step {self.step:.4g}, {100 * self.share:.1f} % pruned"


class _Search:
    """A search over the share of pruned leaves and the step.

    Only one octree is in memory. Coding it takes longer than a trial, so it is made and coded only where its size is
    needed.
    """

    def __init__(
        self,
        octree: SparseVoxelOctree,
        own: RadianceField,
        rows: Rows,
        importance: Importance,
        judge: LossMeter,
        coded_size: Callable[[QuantisedOctree], int],
        tell: Callable[[str], None],
    ) -> None:
        self._octree, self._own, self._rows = octree, own, rows
        self._gram, self._order = importance.gram, by_importance(importance)
        self._judge, self._coded_size, self._tell = judge, coded_size, tell
        # Squared error by share. The error of a lower basis is included, as that of share 0.
        with progress.listening(None):
            self._pruning = {0.0: judge.cost(own).error}
        self._trials = 0
        self._coefficients: tuple[float, Coefficients] | None = None  # of this share
        self._last: tuple[_Tried, QuantisedOctree] | None = None  # of the trial that was coded last
        self._sizes: dict[_Tried, int] = {}

    # -- the three goals ---------------------------------------------------------------------------------------
    def within_loss(self, most: float, size: int | None) -> Compression:
        """Search the smallest octree with a loss of at most `most`, or within_size() if it exceeds `size` bytes."""
        allowed = self._judge.allowed_error(most)
        allowed = max(allowed - self._pruning[0.0], 0.01 * allowed)
        share, step = self._share_for(_PRUNED * allowed), _FIRST * float(np.sqrt(allowed))
        best: _Tried | None = None
        points: list[tuple[float, float]] = []
        for _ in range(_TRIALS):
            tried = self._trial(share, step)
            points.append((step, tried.loss / most))
            if tried.loss <= most and (best is None or tried.step > best.step):
                best = tried
            if best is not None and best.loss >= _NEAR_LOSS * most:
                break
            step = next_step(points, slope=2.0)
            if step == points[-1][0]:
                break
            if size is not None and not self._sizes:
                grown = (step / tried.step) ** -_SIZE_SLOPE
                if self._size(tried) * grown > _FAR * size:
                    return self.within_size(size, tried)
        found = best or tried
        if size is not None and self._size(found) > size:
            return self.within_size(size, found)
        made = self._made(found)
        made.require(most)
        return made

    def within_size(self, most: int, near: _Tried | None = None) -> Compression:
        """Search the best octree of at most `most` bytes. near: an earlier trial, which was too large."""
        share, step = 0.0, _FIRST * float(np.sqrt(self._judge.allowed_error(0.1)))
        if near is not None:
            step = near.step * (self._size(near) / most) ** (1 / _SIZE_SLOPE)
            share = self._share_for_rounding(near, step)
        best: _Tried | None = None
        points: list[tuple[float, float]] = []
        for count in range(_TRIALS):
            tried = self._trial(share, step)
            size = self._size(tried)
            points.append((step, size / most))
            if size <= most and (best is None or tried.loss < best.loss):
                best = tried
            if best is not None and self._size(best) >= _NEAR_SIZE * most:
                break
            step = next_step(points, slope=-_SIZE_SLOPE)
            if step == points[-1][0]:
                break
            if count < _SHARES:
                share = self._share_for_rounding(tried, step)
                points = points if share == tried.share else points[-1:]
        if best is None:
            raise BudgetMissed(Problem("the octree", f"takes at least {size:,} bytes", f"`max_size={most:,}`"))
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
        octree, cost = self._quantised(tried), (tried.error, tried.loss)
        return Compression(octree, tried.share, size, *cost, measured, judge.source_psnr, judge.views)

    def _share_for_rounding(self, near: _Tried, step: float) -> float:
        """Return the share to prune at another step, from the rounding error of a trial."""
        rounding = max(near.error - self._pruning[near.share], 0.0) * (step / near.step) ** 2
        return self._share_for(_PRUNED / (1 - _PRUNED) * rounding)

    def _share_for(self, allowed: float) -> float:
        """Return the largest share that adds at most this squared error, by bisection: the error grows with it."""
        low, high = 0.0, _MOST_PRUNED
        allowed += self._pruning[low]
        for _ in self._halvings():
            middle = (low + high) / 2
            if middle not in self._pruning:
                keep = most_important(self._order, middle)
                self._pruning[middle] = self._cost(keep, -2 - keep, self._own.values).error
            low, high = (middle, high) if self._pruning[middle] <= allowed else (low, middle)
        return low

    def _halvings(self) -> Iterator[int]:
        """Iterate with progress for the first share only. Later searches find most of their errors in the cache."""
        first = len(self._pruning) == 1 and not self._trials
        with progress.part(_WEIGHED, _SHARED) if first else progress.listening(None):
            yield from progress.each(range(_HALVINGS))

    def _cost(self, keep: Rows, slots: Rows, values: npt.NDArray[np.float32]) -> Loss:
        """Return the loss of the field with only these leaves, with these slots and values."""
        own = self._own
        slot = np.full(len(own.values), EMPTY, np.int32)
        slot[keep] = slots
        return self._judge.cost(replace(own, cells=with_rows(own.cells, slot), values=values))


def _edge(octree: SparseVoxelOctree) -> int:
    """Return the pixels along an edge, proportional to the octree's voxels, from _EDGE to four times _EDGE."""
    return _EDGE * min(max(_VOXELS, *octree.size), 4 * _VOXELS) // _VOXELS


def _done(trials: int, begin: float) -> float:
    """Return the progress after a number of trials. It is an estimate, since their total number is unknown."""
    return begin + (1 - begin) * trials / (trials + max(1, _USUAL - trials))


def next_step(points: list[tuple[float, float]], *, slope: float) -> float:
    """Return the next step to try, from pairs (step, result / allowed result) of all earlier trials.

    The target is a ratio a little below 1. The step is interpolated on a logarithmic line between the two nearest
    steps on both sides of the target, or extrapolated with this slope from the nearest one. It stays within STEPS.
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
