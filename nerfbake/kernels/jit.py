"""numba's compiler, with the options that every kernel here uses and the types that it drops.

Compiled code is kept beside the module, or in the user's cache, so that only the first run ever pays for it; where
neither can be written, every run does. It lets go of the interpreter, for kernels.parallel.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from typing import Any, Literal, NamedTuple, TypeVar, cast

import numba
from numba.core import event

# Of the libraries that share a parallel loop out to threads, numba would take TBB wherever it is installed. There each
# loop takes longer than the loops before it (1,500 small ones, six times over: 0.09, 0.15, 0.29, 0.58, 0.84 and 1.14
# CPU seconds); OpenMP's stay as they are. Numba's own `workqueue` ends a process that starts two loops side by side.
if "NUMBA_THREADING_LAYER_PRIORITY" not in os.environ:
    numba.config.THREADING_LAYER_PRIORITY = ["omp", "tbb", "workqueue"]  # type: ignore[attr-defined]

# A thread of OpenMP's that waits for the others keeps its core busy for a while, unless it is told not to before the
# library is loaded. On two cores a sample of nerf2mesh took 1.9 CPU seconds and not 1.0; with a second process doing
# the same beside it, 4.0 and not 0.9, the first of each process 11.5 and not 1.5.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

uncached: list[str] = []  # kernels that are compiled anew in every process


class Compiling(NamedTuple):
    """Seconds of the compiler's own thread, and seconds that passed meanwhile."""

    worked: float = 0.0
    passed: float = 0.0


class _Stopwatch(event.Listener):
    """Compiling one kernel may make it compile another."""

    def __init__(self) -> None:
        self.total, self._depth, self._start = Compiling(), 0, Compiling()

    def on_start(self, event: object) -> None:
        if not self._depth:
            self._start = Compiling(time.thread_time(), time.perf_counter())
        self._depth += 1

    @property
    def seconds(self) -> float:
        """Since the kernel that is being compiled was begun; 0 where there is none."""
        return time.perf_counter() - self._start.passed if self._depth else 0.0

    def on_end(self, event: object) -> None:
        self._depth -= 1
        if not self._depth:
            worked = self.total.worked + time.thread_time() - self._start.worked
            self.total = Compiling(worked, self.total.passed + time.perf_counter() - self._start.passed)


_stopwatch = _Stopwatch()
event.register("numba:compile", _stopwatch)  # type: ignore[no-untyped-call]

Function = TypeVar("Function", bound=Callable[..., Any])


def compiling() -> Compiling:
    """What this process has spent on compiling kernels: only a first run does."""
    return _stopwatch.total


def compiling_for() -> float:
    """For how many seconds a kernel has been compiled by now; 0 where none is."""
    return _stopwatch.seconds


def compiled(*, parallel: bool = False, inline: bool = False, merged: bool = False) -> Callable[[Function], Function]:
    """Compiles a function.

    inline and merged put it into its callers: inline before types are known, merged when machine code is made. A merged
    one costs nothing for arrays in tuples if it names them where it uses them (`coder.data[i]`); arrays that are first
    unpacked, and rows of arrays, have their references counted, which takes longer than what is done with them.

    A division by zero gives what IEEE 754 says: a kernel that asks before each one cannot be vectorised.

    There is no fastmath: it lets the compiler reorder, fuse and estimate by what the CPU has, and the last bits of what
    comes out would tell one CPU from another. Where a sum is to be vectorised, the code says which terms go together.
    """

    def compile_(function: Function) -> Function:
        how: Literal["always", "never"] = "always" if inline else "never"
        options: Any = {"nogil": True, "parallel": parallel, "inline": how, "forceinline": merged}
        options["error_model"] = "numpy"
        try:
            result: Any = numba.njit(function, cache=True, **options)
        except RuntimeError:  # numba found no folder that it may write to
            uncached.append(function.__name__)
            result = numba.njit(function, **options)
        return cast(Function, result)

    return compile_
