"""A trainer that takes no time: it draws nearer to the sample scene, and remembers what it was asked for."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import cache
from types import SimpleNamespace
from typing import Any, ClassVar

import numpy as np
import pytest

from nerfbake import BrickField, Views, build_bricks, build_field, build_octree, measure_views, sample_n3tree
from nerfbake.errors import InvalidScene, Problem
from nerfbake.stages.overlap import Overlap


@cache
def goal() -> BrickField:
    return build_bricks(build_octree(sample_n3tree(resolution=16, basis="SH1")))


@dataclass(frozen=True)
class FakeState:
    """Step by step: `done` of `of`, the last of which is the goal. stage, epoch and view say how many are done."""

    stage: int
    epoch: int
    view: int
    done: int
    of: int
    resolution: int = 16
    overlap: ClassVar[Overlap | None] = None
    cells: Any = field(default_factory=lambda: SimpleNamespace(n=7))

    def field(self) -> BrickField:
        return replace(goal(), values=goal().values * np.float32((self.done + 1) / self.of))

    def return_to_cpu(self) -> None:
        """Return to what was read last: this state never is elsewhere."""

    def arrays(self) -> dict[str, Any]:
        return {"at": np.array([self.stage, self.epoch, self.view, self.done, self.of])}

    @staticmethod
    def of_arrays(arrays: dict[str, Any]) -> FakeState:
        if set(arrays) != {"at"} or arrays["at"].shape != (5,):
            raise InvalidScene(Problem("at", "is no state", "5 numbers"))
        return FakeState(*map(int, arrays["at"]))


def _measured(state: FakeState, views: Views, *, samples: int) -> float:
    return float(np.mean([view.psnr for view in measure_views(build_field(state.field()), views, samples=samples)]))


def _counted(stage: int, epoch: int, view: int, views: int, epochs: int) -> tuple[int, int, int]:
    epoch, view = divmod(epoch * views + view, views)
    return (stage + 1, 0, 0) if epoch == epochs else (stage, epoch, view)


@dataclass
class FakeFit:
    """asked: the options of every call; steps: how many states were given; at_step: what happens then."""

    asked: list[dict[str, Any]] = field(default_factory=list)
    steps: int = 0
    at_step: dict[int, Callable[[], None]] = field(default_factory=dict)
    often: ClassVar[int] = 4  # views from state to state

    def __call__(self, views: Any, *, schedule: Any, start: FakeState | None, **options: Any) -> Iterator[FakeState]:
        self.asked.append({"views": views, "schedule": schedule, "start": start, **options})
        count = len(views.pictures)
        places = [
            _counted(stage, epoch, view, count, plan.epochs)
            for stage, plan in enumerate(schedule)
            for epoch in range(plan.epochs)
            for view in range(self.often, count + 1, self.often)
        ]
        for done, place in enumerate(places):
            if start is None or done > start.done:
                self.steps += 1
                self.at_step.get(self.steps, lambda: None)()
                yield FakeState(*place, done, len(places))


def fake_fit(monkeypatch: pytest.MonkeyPatch) -> FakeFit:
    """Put the fake in the place of the trainer, its state and its measure."""
    fake = FakeFit()
    for name, made in (("fit_field", fake), ("FitState", FakeState), ("measure_state", _measured)):
        monkeypatch.setattr(f"nerfbake.stages.views_to_field.{name}", made)
    return fake
