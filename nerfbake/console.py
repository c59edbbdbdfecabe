"""Messages and progress of a command. Everything goes to stderr, so that stdout contains data only."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from typing import Any, Literal

from nerfbake import io, progress
from nerfbake.errors import for_shell, one_line
from nerfbake.kernels import compile_times

LONGEST_TOLD = 2000  # characters: some messages are meant to be copied, such as the schedule of a fit
PATIENCE = 1.0  # seconds before a step is displayed
EVERY = {"bar": 0.1, "plain": 10.0, "json": 1.0}  # seconds between two updates
COMPILING = "compiling kernels, once on this machine"

Mode = Literal["auto", "plain", "json"]


class ConsoleStep:
    """A step of the work: its name, its current detail, and the share that is done (0 to 1, None if unknown)."""

    def __init__(self, name: str) -> None:
        self.name, self.detail = name, ""
        self.start = time.perf_counter()
        self.share: float | None = None
        self._first: tuple[float, float] | None = None  # time and value of the first reported share

    def report(self, share: float, detail: str) -> None:
        self._first = self._first or (time.perf_counter(), share)
        self.share, self.detail = max(share, self.share or 0.0), detail or self.detail

    @property
    def seconds(self) -> float:
        return time.perf_counter() - self.start

    @property
    def seconds_left(self) -> float | None:
        """Seconds left at the rate since the first report, or None. A resumed step does not start at a share of 0."""
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
        """The time left if it is known, else the elapsed time."""
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


class Console:
    """Prints messages and progress: one line for each written file.

    quiet    print only errors
    verbose  also print each step with its time
    mode     display of steps that last longer than PATIENCE. auto: a bar on a terminal, nothing elsewhere; plain: a
             line every ten seconds; json: a JSON object per line, every second
    """

    def __init__(self, *, quiet: bool, verbose: bool, mode: Mode = "auto") -> None:
        self._quiet, self._verbose, self._noted = quiet, verbose, False
        self._steps: list[ConsoleStep] = []
        terminal = sys.stderr is not None and sys.stderr.isatty()
        self._mode = None if quiet else mode if mode != "auto" else "bar" if terminal else None

    def say(self, text: str) -> None:
        if not self._quiet:
            _print(one_line(for_shell(text), LONGEST_TOLD))

    @contextmanager
    def phase(self, text: str) -> Iterator[Callable[[str], None]]:
        """Run a block as a step of the work. Steps may be nested.

        The name, detail and share of the step are displayed once it has lasted a second. In verbose mode each detail
        and the time of the step are printed.
        """
        step = ConsoleStep(text)

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
        """Display the innermost step from a thread, which runs as long as the outermost step."""
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
            _print(io.json_line(step.facts) if mode == "json" else step.plain)

    def _innermost(self) -> ConsoleStep:
        """The innermost step that has lasted longer than PATIENCE or whose share is known, else the outermost step."""
        steps = list(self._steps)
        known = (step for step in reversed(steps) if step.seconds > PATIENCE or step.share is not None)
        return next(known, steps[0])

    def _tell_of_uncached_kernels(self) -> None:
        if compile_times.uncached and not self._noted:
            self._noted = True
            self.say("note: no cache folder can be written (read-only, or full), so kernels are compiled again")


def _print(line: str) -> None:
    if sys.stderr is not None:  # a program without a terminal, on Windows, has none
        with suppress(OSError):  # a full stderr must not stop the work
            print(line, file=sys.stderr, flush=True)


def _draw(step: Callable[[], ConsoleStep], done: threading.Event) -> None:
    """Draw a bar as wide as the terminal. If the line does not fit, the text is shortened, not the time left."""
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
    """Format a time as 1:05 or 1:00:05."""
    whole = round(seconds)
    hours, minutes = whole // 3600, whole // 60 % 60
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"


def _is_compiling() -> bool:
    """Return whether numba has been compiling a kernel for longer than PATIENCE."""
    return compile_times.compiling_for() > PATIENCE
