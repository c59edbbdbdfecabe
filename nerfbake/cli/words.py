"""What a command says while it works: all of it on stderr, so that stdout is data alone."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Literal

import click

from nerfbake import io, progress
from nerfbake.errors import for_shell, one_line

LONGEST_TOLD = 2000  # characters: what is said may be meant to be pasted, as a schedule is
PATIENCE = 1.0  # seconds before a step is shown
EVERY = {"bar": 0.1, "plain": 10.0, "json": 1.0}  # seconds from one look at a step to the next
COMPILING = "compiling kernels, once on this machine"

Mode = Literal["auto", "plain", "json"]


class Step:
    """A step of the work: its name, where it is, and the share of it that is done, None while nobody knows."""

    def __init__(self, name: str) -> None:
        self.name, self.detail = name, ""
        self.start = time.perf_counter()
        self.share: float | None = None
        self._first: tuple[float, float] | None = None  # when the first share was reported, and which

    def report(self, share: float, detail: str) -> None:
        self._first = self._first or (time.perf_counter(), share)
        self.share, self.detail = max(share, self.share or 0.0), detail or self.detail

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.start

    @property
    def seconds_left(self) -> float | None:
        """By the pace since the first report: a step that goes on where another run stopped does not begin at 0."""
        if self.share is None or self._first is None or self.share <= self._first[1]:
            return None
        since, first = self._first
        return (time.perf_counter() - since) * (1 - self.share) / (self.share - first)

    @property
    def text(self) -> str:
        name = f"{self.name}: {self.detail}" if self.detail else self.name
        return COMPILING if _is_compiling() else one_line(name, LONGEST_TOLD)

    @property
    def clock(self) -> str:
        """The time that is left, or that has passed where nobody knows."""
        left = self.seconds_left
        return _clock(self.seconds) if left is None else f"{_clock(left)} left"

    @property
    def plain(self) -> str:
        return f"{self.text}: {'' if self.share is None else f'{100 * self.share:.0f} %, '}{self.clock}"

    @property
    def facts(self) -> dict[str, Any]:
        left = self.seconds_left
        return {
            "event": "progress",
            "step": self.name,
            "detail": self.detail,
            "compiling": _is_compiling(),
            "share": None if self.share is None else round(self.share, 4),
            "seconds": round(self.seconds, 1),
            "seconds_left": None if left is None else round(left, 1),
        }


class Words:
    """quiet: nothing but errors. verbose: each step with its time. Else one line for each file written.

    mode  how a step that lasts longer than PATIENCE is shown: auto: a bar on a terminal, nothing elsewhere; plain: a
          line every ten seconds; json: an object a line, every second
    """

    def __init__(self, *, quiet: bool, verbose: bool, mode: Mode = "auto") -> None:
        self._quiet, self._verbose, self._told = quiet, verbose, False
        self._steps: list[Step] = []
        terminal = sys.stderr is not None and sys.stderr.isatty()
        self._mode = None if quiet else mode if mode != "auto" else "bar" if terminal else None

    def say(self, text: str) -> None:
        if not self._quiet:
            with suppress(OSError):  # a full stderr costs no data
                click.echo(one_line(for_shell(text), LONGEST_TOLD), err=True)

    @contextmanager
    def phase(self, text: str) -> Iterator[Callable[[str], None]]:
        """A step of the work, which may be part of another. Its name, where it is and how much is done are shown once
        it has lasted a second; verbose says where it is each time, and how long it took."""
        step = Step(text)

        def tell(more: str) -> None:
            step.detail = more
            if self._verbose:
                self.say(f"{text}: {more}")

        self._steps.append(step)
        try:
            with self._shown(), progress.listening(step.report):
                yield tell
        finally:
            self._steps.remove(step)
        if self._verbose:
            self.say(f"{text}: {step.seconds:.2f} s")
            self._tell_of_uncached_kernels()

    @contextmanager
    def _shown(self) -> Iterator[None]:
        """One thread shows the innermost step, for as long as the outermost lasts."""
        if self._mode is None or len(self._steps) > 1:
            yield
            return
        done = threading.Event()
        shown = threading.Thread(target=self._show, args=(self._mode, done), daemon=True)
        shown.start()
        try:
            yield
        finally:
            done.set()
            shown.join()

    def _show(self, mode: str, done: threading.Event) -> None:
        if done.wait(PATIENCE):
            return
        if mode == "bar":
            _draw(self._innermost, done)
            return
        while not done.wait(EVERY[mode]):
            step = self._innermost()
            with suppress(OSError):
                click.echo(io.json_line(step.facts) if mode == "json" else step.plain, err=True)

    def _innermost(self) -> Step:
        """The last step that has been going on for a while, or that knows its share; else the outermost."""
        steps = list(self._steps)
        known = (step for step in reversed(steps) if step.seconds > PATIENCE or step.share is not None)
        return next(known, steps[0])

    def _tell_of_uncached_kernels(self) -> None:
        jit = sys.modules.get("nerfbake.kernels.jit")
        if jit is not None and jit.uncached and not self._told:
            self._told = True
            self.say("note: no folder can be written that would keep compiled kernels; kernels are compiled anew")


def _draw(step: Callable[[], Step], done: threading.Event) -> None:
    """A bar on the terminal, as wide as that is: what does not fit is cut off the text, not off the time left."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn
    from rich.table import Column

    text = TextColumn(
        "{task.description}", markup=False, table_column=Column(ratio=1, no_wrap=True, overflow="ellipsis")
    )
    clock = TextColumn("{task.fields[clock]}", table_column=Column(no_wrap=True, justify="right", min_width=9))
    columns = (SpinnerColumn(), text, BarColumn(20), TaskProgressColumn(), clock)
    with Progress(*columns, console=Console(stderr=True), transient=True, expand=True) as shown:
        task = shown.add_task("", total=None, clock="")
        while True:
            now = step()
            total = None if now.share is None else 1.0
            shown.update(task, description=now.text, total=total, completed=now.share or 0.0, clock=now.clock)
            if done.wait(EVERY["bar"]):
                return


def _clock(seconds: float) -> str:
    """1:05, or 1:00:05."""
    whole = round(seconds)
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"


def _is_compiling() -> bool:
    """Has numba been at work on a kernel for a while?"""
    jit = sys.modules.get("nerfbake.kernels.jit")
    return jit is not None and jit.compiling_for() > PATIENCE
