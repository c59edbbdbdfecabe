"""The course of a fit: how long it has worked, how much is done, and how near it has come to views it has not seen."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, NamedTuple

import nerfbake
from nerfbake.errors import MemoryLimit
from nerfbake.jobs.photographs import Posed

if TYPE_CHECKING:
    from nerfbake.scene.schedule import Schedule, Stage

HANDFUL = 4  # views that are looked at while a fit goes on
_PATIENCE = 0.1  # of the time that a fit has worked: no more of it is spent on looking


class Point(NamedTuple):
    """How near a fit had come at the end of an epoch.

    seconds     CPU seconds of work until then, without compiling kernels and without looking
    psnr        dB, the mean over a handful of the views that judge
    stage       how many stages were done, and epochs of the next one
    resolution  of the finest lattice, and cells in it
    """

    seconds: float
    psnr: float
    stage: int
    epoch: int
    resolution: int
    cells: int


class Clock:
    """CPU seconds of all threads, and seconds as they pass; pauses and the compiler do not count."""

    def __init__(self, worked: float = 0.0) -> None:
        self._worked, self._passed = worked - _working(), -_passing()

    @property
    def worked(self) -> float:
        return self._worked + _working()

    @property
    def passed(self) -> float:
        return self._passed + _passing()

    @contextmanager
    def paused(self) -> Iterator[None]:
        worked, passed = _working(), _passing()
        try:
            yield
        finally:
            self._worked -= _working() - worked
            self._passed -= _passing() - passed


def _working() -> float:
    jit = sys.modules.get("nerfbake.kernels.jit")
    return time.process_time() - (jit.compiling().worked if jit else 0.0)


def _passing() -> float:
    jit = sys.modules.get("nerfbake.kernels.jit")
    return time.perf_counter() - (jit.compiling().passed if jit else 0.0)


def _cost(stage: Stage) -> float:
    """Of an epoch, beside those of other stages: neither pictures nor cells cost as much as they grow."""
    return stage.cells * (1 + stage.rays) / (1 + stage.scale)


class Course:
    """Follows a fit from state to state, as far as its schedule goes."""

    def __init__(self, posed: Posed, schedule: Schedule) -> None:
        judges = posed.judges
        self._views, self._schedule = len(posed.trained.pictures), schedule
        count = len(judges.pictures)
        self._which = f"{min(count, HANDFUL)} of {count} views kept for judging"
        self._judges = judges.take(range(0, count, max(1, count // HANDFUL))[:HANDFUL])
        self._looked, self._epoch = 0.0, (0, 0)
        self.clock, self.curve = Clock(), list[Point]()

    def goes_on(self, now: Any, *, worked: float, curve: Sequence[Point]) -> None:
        """From where an earlier run was stopped."""
        self._epoch = now.stage, now.epoch
        self.clock, self.curve = Clock(worked), list(curve)

    def follow(self, now: Any) -> bool:
        """Whether an epoch has ended since the last state: then what there is has been looked at."""
        epoch = now.stage, now.epoch
        ended, self._epoch = epoch != self._epoch, epoch
        if ended:
            self._look(now)
        return ended

    def _look(self, now: Any) -> None:
        """Unless that takes too long beside the work itself."""
        worked = self.clock.worked
        if self._looked > _PATIENCE * worked and self.curve:
            return
        before = time.process_time()
        with self.clock.paused():
            psnr = self._seen(now)
        self._looked += time.process_time() - before
        if psnr is not None:
            self.curve.append(Point(worked, psnr, now.stage, now.epoch, now.resolution, now.cells.n))

    def share(self, now: Any) -> float:
        """Of the work that is done, 0 to 1."""
        costs = [stage.epochs * _cost(stage) for stage in self._schedule]
        begun = sum(_cost(stage) for stage in self._schedule[now.stage : now.stage + 1])
        return float(sum(costs[: now.stage]) + begun * (now.epoch + now.view / self._views)) / sum(costs)

    def told(self, now: Any) -> str:
        """Where it is, for whoever watches."""
        seen = f", {self.curve[-1].psnr:.2f} dB on {self._which}" if self.curve else ""
        stage = min(now.stage + 1, len(self._schedule))
        return f"stage {stage} of {len(self._schedule)}, {now.resolution}^3, {now.cells.n:,} voxels{seen}"

    def _seen(self, now: Any) -> float | None:
        try:
            field = nerfbake.build_field(now.field())
            errors = nerfbake.measure_views(field, self._judges, samples=self._schedule[-1].rays)
        except MemoryLimit:
            return None  # the fit itself has room
        return sum(error.psnr for error in errors) / len(errors)
