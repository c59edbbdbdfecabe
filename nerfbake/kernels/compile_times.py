"""How long this process has compiled kernels, and which kernels are not cached. This module does not import numba.

kernels.jit updates these counters. Messages and clocks read them, also in processes that never load a kernel.
"""

from __future__ import annotations

import time
from typing import NamedTuple

uncached: list[str] = []  # names of kernels that are compiled again in every process


class CompileTime(NamedTuple):
    """CPU seconds of the compiling thread, and elapsed seconds."""

    worked: float = 0.0
    passed: float = 0.0


class _Stopwatch:
    """Measures compile times. Compiling one kernel may start the compilation of another."""

    def __init__(self) -> None:
        self.total, self._depth, self._start = CompileTime(), 0, CompileTime()

    def start(self) -> None:
        if not self._depth:
            self._start = CompileTime(time.thread_time(), time.perf_counter())
        self._depth += 1

    @property
    def seconds(self) -> float:
        """Seconds since the outermost compilation in progress started; 0 if there is none."""
        return time.perf_counter() - self._start.passed if self._depth else 0.0

    def stop(self) -> None:
        self._depth -= 1
        if not self._depth:
            worked = self.total.worked + time.thread_time() - self._start.worked
            self.total = CompileTime(worked, self.total.passed + time.perf_counter() - self._start.passed)


stopwatch = _Stopwatch()


def compiling() -> CompileTime:
    """Return the time that this process has spent on compiling kernels: only a first run compiles."""
    return stopwatch.total


def compiling_for() -> float:
    """Return for how many seconds a kernel has been compiling; 0 if none is."""
    return stopwatch.seconds
