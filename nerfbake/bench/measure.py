"""Measure time and peak memory of functions and commands, each run in a separate process.

measure() runs a function in a child process, `python -m nerfbake.bench.measure MODULE FUNCTION ARGUMENTS`. A memory
peak belongs to a process: earlier work in the same process would hide the peak of later work. A library that is missing
or fails is also a result.

measure_process() measures a command from its start to its end, as a user experiences it. The operating system counts
the memory of the parent process as the first memory of a new process. So a small process starts the command, however
much memory the benchmark itself uses.

A Progress is a context around each step that reports what the benchmark is doing.
"""

from __future__ import annotations

import atexit
import json
import os
import resource
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from nerfbake.bench.environment import command_for
from nerfbake.errors import NerfbakeError


def measure_process(*command: str | Path, environment: Mapping[str, str] | None = None, keep: bool = False) -> Result:
    """Measure a command. The peak is that of its whole process, the interpreter included.

    environment: variables in addition to the current ones. facts["worked"]: CPU seconds of all its processes. keep:
    facts["stdout"] contains its standard output. Raises NerfbakeError with the last line of its standard error if it
    fails.
    """
    variables = {**_compiled_modules(), **(environment or {})}
    result = measure(run_command, command=[str(word) for word in command], environment=variables, keep=keep)
    if result.error:
        raise NerfbakeError(result.error)
    return result._replace(peak=result.facts["peak"])


def run_command(command: list[str], environment: dict[str, str], keep: bool) -> Work:
    """The work of running the command, with its output discarded or kept; called in the child process."""

    def run() -> tuple[int, float, str]:
        with tempfile.TemporaryFile() as words, tempfile.TemporaryFile() as printed:
            stdout = printed if keep else subprocess.DEVNULL
            process = subprocess.Popen(command, stdout=stdout, stderr=words, env={**os.environ, **environment})
            _, status, usage = os.wait4(process.pid, 0)
            process.returncode = os.waitstatus_to_exitcode(status)
            if process.returncode:
                words.seek(0)
                last = words.read().decode(errors="replace").strip().rpartition("\n")[2]
                raise NerfbakeError(f"{' '.join(command)} exited with {process.returncode}: {last}")
            printed.seek(0)
            return resident_bytes(usage), usage.ru_utime + usage.ru_stime, printed.read().decode()

    return Work(run, lambda found: dict(zip(("peak", "worked", "stdout"), found, strict=True)))


@cache
def _compiled_modules() -> dict[str, str]:
    """Environment variables for a folder of compiled Python modules.

    After a command has run once, its modules are compiled, as in an installation.
    """
    folder = tempfile.mkdtemp(prefix="nerfbake-bench-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder}


Progress = Callable[[str], AbstractContextManager[object]]


@contextmanager
def announced(text: str) -> Iterator[None]:
    """Print a line to standard error when the step begins."""
    print(text, file=sys.stderr, flush=True)
    yield


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


def in_turn(*works: Callable[[], Found], rounds: int) -> list[list[Found]]:
    """Run the works in turn for a warm-up round and `rounds` rounds; return their results by work, then by round."""
    found = [[work() for work in works] for _ in range(rounds + 1)][1:]
    return [list(of_work) for of_work in zip(*found, strict=True)]


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
        return resident_bytes(resource.getrusage(resource.RUSAGE_SELF))


def _status(key: str) -> int:
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in lines if line.startswith(f"{key}:"))


if __name__ == "__main__":
    print(json.dumps(measure_here(sys.argv[1], sys.argv[2], json.loads(sys.argv[3]))._asdict()))
