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
from typing import Any, NamedTuple

from nerfbake.errors import NerfbakeError

TIMEOUT = 1800  # seconds for one piece of work


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


class Spread(NamedTuple):
    """What several rounds gave."""

    median: float
    low: float
    high: float
    rounds: int

    @staticmethod
    def of(values: list[float]) -> Spread:
        return Spread(statistics.median(values), min(values), max(values), len(values))


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


def _child(module: str, function: str, arguments: dict[str, Any]) -> Result:
    try:
        work: Work = getattr(import_module(module), function)(**arguments)
        before = _reset_peak()
        start = time.perf_counter()
        result = work.run()
        seconds = time.perf_counter() - start
        peak = _peak() - before
        return Result(seconds, peak, work.check(result))
    except ImportError as error:
        return Result(error=f"not installed: {error.name}")
    except NerfbakeError as error:
        return Result(error=str(error))


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
        most = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return most if sys.platform == "darwin" else most * 1024


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))


if __name__ == "__main__":
    print(json.dumps(_child(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))._asdict()))
