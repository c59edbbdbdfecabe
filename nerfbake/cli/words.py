"""What a command says while it works: all of it on stderr, so that stdout is data alone."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import click

from nerfbake.errors import one_line

LONGEST_TOLD = 2000  # characters: what is said may be meant to be pasted, as a schedule is
PATIENCE = 1.0  # seconds before a terminal shows that something is going on


class Words:
    """quiet: nothing but errors. verbose: each step with its time. Else one line for each file written."""

    def __init__(self, *, quiet: bool, verbose: bool) -> None:
        self._quiet, self._verbose, self._told = quiet, verbose, False

    def say(self, text: str) -> None:
        if not self._quiet:
            with suppress(OSError):  # a full stderr costs no data
                click.echo(one_line(text, LONGEST_TOLD), err=True)

    @contextmanager
    def phase(self, text: str) -> Iterator[Callable[[str], None]]:
        """A step of the work: a terminal shows a spinner once it has lasted a second, a pipe shows nothing. What the
        step tells of itself stands beside the spinner; verbose says all of it."""
        start, done, shown = time.perf_counter(), threading.Event(), [text]
        spinner = threading.Thread(target=_spin, args=(shown, done), daemon=True)

        def tell(more: str) -> None:
            shown[0] = f"{text}: {more}"
            if self._verbose:
                self.say(shown[0])

        if sys.stderr is not None and sys.stderr.isatty() and not self._quiet:
            spinner.start()
        try:
            yield tell
        finally:
            done.set()
            if spinner.is_alive():
                spinner.join()
        self._end(text, start)

    @contextmanager
    def progress(self, text: str) -> Iterator[Callable[[float, str], None]]:
        """A long step: a terminal shows a bar with the time that is left, a pipe shows nothing."""
        start = time.perf_counter()
        if sys.stderr is not None and sys.stderr.isatty() and not self._quiet:
            with _bar(text) as tell:
                yield tell
        else:
            yield lambda share, told: None
        self._end(text, start)

    def _end(self, text: str, start: float) -> None:
        if self._verbose:
            self.say(f"{text}: {time.perf_counter() - start:.2f} s")
            self._tell_of_uncached_kernels()

    def _tell_of_uncached_kernels(self) -> None:
        jit = sys.modules.get("nerfbake.kernels.jit")
        if jit is not None and jit.uncached and not self._told:
            self._told = True
            self.say("note: no folder can be written that would keep compiled kernels; kernels are compiled anew")


@contextmanager
def _bar(text: str) -> Iterator[Callable[[float, str], None]]:
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TaskProgressColumn, TextColumn, TimeRemainingColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), BarColumn(), TaskProgressColumn())
    with Progress(*columns, TimeRemainingColumn(), console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(text, total=1.0)
        yield lambda share, told: progress.update(task, completed=share, description=f"{text}: {told}")


def _spin(shown: list[str], done: threading.Event) -> None:
    if done.wait(PATIENCE):
        return
    from rich.console import Console
    from rich.progress import Progress, SpinnerColumn, TextColumn, TimeElapsedColumn

    columns = (SpinnerColumn(), TextColumn("{task.description}", markup=False), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True), transient=True) as progress:
        task = progress.add_task(shown[0], total=None)
        while not done.wait(0.1):
            progress.update(task, description=shown[0])
