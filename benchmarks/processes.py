"""Measure commands, each in processes of its own, and announce the steps of a benchmark.

measure_process() measures a command from its start to its end, as a user experiences it. The operating system counts
the memory of the parent process as the first memory of a new process. So a small process starts the command, however
much memory the benchmark itself uses.
"""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import TypeVar

from nerfbake.bench.measure import Result, Work, measure, resident_bytes
from nerfbake.errors import NerfbakeError

Found = TypeVar("Found")


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


def in_turn(*works: Callable[[], Found], rounds: int) -> list[list[Found]]:
    """Run the works in turn for a warm-up round and `rounds` rounds; return their results by work, then by round."""
    found = [[work() for work in works] for _ in range(rounds + 1)][1:]
    return [list(of_work) for of_work in zip(*found, strict=True)]


@contextmanager
def announced(text: str) -> Iterator[None]:
    """Print a line to standard error when the step begins."""
    print(text, file=sys.stderr, flush=True)
    yield
