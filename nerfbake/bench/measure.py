"""Measure time and peak memory of functions and commands, each run in a separate process.

measure() runs a function in a child process, `python -m nerfbake.bench.measure MODULE FUNCTION ARGUMENTS`. A memory
peak belongs to a process: earlier work in the same process would hide the peak of later work. A library that is missing
or fails is also a result.

A Progress is a context around each step that reports what the benchmark is doing.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar

from nerfbake.errors import NerfbakeError
from nerfbake.installation import command_for

if TYPE_CHECKING:
    import resource

Progress = Callable[[str], AbstractContextManager[object]]
TIMEOUT = 1800  # seconds for one run
Found = TypeVar("Found")


class Work(NamedTuple):
    """The work of a child: `run` is measured; `check` then takes its result and returns facts."""

    run: Callable[[], Any]
    check: Callable[[Any], dict[str, Any]]


class Result(NamedTuple):
    """One measured run. peak: bytes that the work added to its process. error: why there are no figures, or ''."""

    seconds: float = 0.0
    peak: int = 0
    facts: Mapping[str, Any] = {}
    error: str = ""


class Statistics(NamedTuple):
    """The median, minimum and maximum of a figure over several rounds."""

    median: float
    low: float
    high: float
    rounds: int

    @staticmethod
    def of(values: list[float]) -> Statistics:
        return Statistics(statistics.median(values), min(values), max(values), len(values))


def measure(function: Callable[..., Work], **arguments: Any) -> Result:
    """Prepare the work in a child process, run it there once, and return its costs. Arguments must be JSON."""
    command = [sys.executable, "-m", __name__, function.__module__, function.__name__, json.dumps(arguments)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return Result(error=f"took longer than {TIMEOUT} s")
    if done.returncode:
        last = (done.stderr.strip() or f"exit {done.returncode}").splitlines()[-1]
        return Result(error=last)
    return Result(**json.loads(done.stdout.splitlines()[-1]))  # lines above it are printed by libraries


def seconds_of(work: Callable[[], Found]) -> tuple[Found, float]:
    """Return the result of the work and its duration in seconds. All benchmarks use this clock."""
    start = time.perf_counter()
    found = work()
    return found, time.perf_counter() - start


def resident_bytes(usage: resource.struct_rusage) -> int:
    """The peak resident memory of a process in bytes, from the operating system."""
    return usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024


def measure_here(module: str, function: str, arguments: dict[str, Any]) -> Result:
    """Measure the work in this process; called by the child of measure()."""
    try:
        work: Work = getattr(import_module(module), function)(**arguments)
        before = _reset_peak()
        result, seconds = seconds_of(work.run)
        peak = _peak() - before
        return Result(seconds, peak, work.check(result))
    except ImportError as error:
        return Result(error="; ".join(filter(None, (f"not installed: {error.name}", command_for(error.name or "")))))
    except NerfbakeError as error:
        return Result(error=error.line)


def _reset_peak() -> int:
    """Reset the peak if the system can; return the memory in use in bytes, otherwise the peak."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return _peak()
    return _status("VmRSS")


def _peak() -> int:
    """The peak memory of this process so far, in bytes."""
    try:
        return _status("VmHWM")
    except OSError:
        import resource  # Windows has none: there, each row says so

        return resident_bytes(resource.getrusage(resource.RUSAGE_SELF))


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))


if __name__ == "__main__":
    print(json.dumps(measure_here(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))._asdict()))
