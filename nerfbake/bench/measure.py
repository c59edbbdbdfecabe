"""Time and peak memory of a piece of work, each time in a process of its own.

A memory peak is a fact about a process: what ran there before hides what runs now. A library that is missing, or that
breaks, is a result too. `python -m nerfbake.bench.measure MODULE FUNCTION ARGUMENTS` is the child.
"""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from nerfbake.bench.extras import command_for
from nerfbake.errors import NerfbakeError

TIMEOUT = 1800  # seconds for one piece of work
Found = TypeVar("Found")


class Work(NamedTuple):
    """What a child does: `run` is measured; `check` looks at its result afterwards and gives facts."""

    run: Callable[[], Any]
    check: Callable[[Any], dict[str, Any]]


class Result(NamedTuple):
    """One measured run. peak: bytes that the work added to its process at most. error: why there are no figures."""

    seconds: float = 0.0
    peak: int = 0
    facts: Mapping[str, Any] = {}
    error: str = ""


class Statistics(NamedTuple):
    """The median of a figure over several rounds, beside its least and its greatest value."""

    median: float
    low: float
    high: float
    rounds: int

    @staticmethod
    def of(values: list[float]) -> Statistics:
        return Statistics(statistics.median(values), min(values), max(values), len(values))


def measure(function: Callable[..., Work], **arguments: Any) -> Result:
    """Prepares the work in a child process, runs it there once, and gives what it cost. Arguments must be JSON."""
    command = [sys.executable, "-m", __name__, function.__module__, function.__name__, json.dumps(arguments)]
    try:
        done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=TIMEOUT)
    except subprocess.TimeoutExpired:
        return Result(error=f"took longer than {TIMEOUT} s")
    if done.returncode:
        last = (done.stderr.strip() or f"exit {done.returncode}").splitlines()[-1]
        return Result(error=last)
    return Result(**json.loads(done.stdout.splitlines()[-1]))  # what stands above is a library's own talk


def seconds_of(work: Callable[[], Found]) -> tuple[Found, float]:
    """What the work gives, and the seconds that it took: the stopwatch of every benchmark."""
    start = time.perf_counter()
    found = work()
    return found, time.perf_counter() - start


def in_turn(*works: Callable[[], Found], rounds: int) -> list[list[Found]]:
    """What each of the works gave in every round; they take turns, after one round that does not count."""
    found = [[work() for work in works] for _ in range(rounds + 1)][1:]
    return [list(of_work) for of_work in zip(*found, strict=True)]


def resident_bytes(usage: resource.struct_rusage) -> int:
    """The most memory that a process held at once, as the operating system tells it."""
    return usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024


def measure_here(module: str, function: str, arguments: dict[str, Any]) -> Result:
    """The same in this process: what the child does."""
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
    """Forgets earlier peaks where the system can; gives the memory in use, in bytes."""
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return _peak()
    return _status("VmRSS")


def _peak() -> int:
    """The process's peak so far, in bytes."""
    try:
        return _status("VmHWM")
    except OSError:
        return resident_bytes(resource.getrusage(resource.RUSAGE_SELF))


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))


if __name__ == "__main__":
    print(json.dumps(measure_here(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))._asdict()))
