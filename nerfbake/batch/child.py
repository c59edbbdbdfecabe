"""Run one item in its own process, and collect its log, result, time, memory peak and exit code.

The process has its own process group, so that Ctrl-C in the terminal does not reach it: the batch decides when it
stops. On Linux it receives SIGTERM when its parent dies for any reason.
"""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import NamedTuple

from nerfbake.errors import Problem, UsageError, one_line
from nerfbake.io import results
from nerfbake.io.own_files import opened_log, trim_log

PARENT = "NERFBAKE_BATCH"  # environment variable with the process ID of the batch
_NOT_STARTED = 126  # exit code of a shell for a command that it cannot start


class ProcessResult(NamedTuple):
    """The result of a process.

    code     exit code; 128 plus the signal number if a signal killed the process
    killed   True if a signal killed the process, or if its exit code is 128 or more
    error    the error message of the command, without `error: `; "" if it reported none
    psnr     PSNR of the output in dB; None if the command reported none
    seconds  run time
    peak     peak memory of the process, in bytes
    """

    code: int
    killed: bool
    error: str
    psnr: float | None
    seconds: float
    peak: int


def require_processes() -> None:
    """Raise UsageError on a system without process groups, and without the costs of a process that has ended."""
    if missing := [name for name in ("wait4", "killpg") if not hasattr(os, name)]:
        raise UsageError(Problem("a batch", f"needs os.{missing[0]}, which {sys.platform} has not", "Linux or macOS"))


class ChildProcesses:
    """The running processes. After stop(), they end soon, and no new ones start."""

    def __init__(self, command: Sequence[str], threads: int) -> None:
        self._command, self._variables = list(command), _variables(threads)
        self._running: set[int] = set()
        self._lock, self.stopped = threading.Lock(), False

    def run(self, argv: Sequence[str], log: Path) -> ProcessResult | None:
        """Run a command line and wait for its end. The output of the process goes to the file `log`.

        Returns None after stop(). Raises OutputError if the log cannot be written.
        """
        begun = time.perf_counter()
        with opened_log(log) as output, _pipe() as (readable, writable):
            with self._lock:
                if self.stopped:
                    return None
                try:
                    process = subprocess.Popen(
                        [*self._command, *argv],
                        stdin=subprocess.DEVNULL,
                        stdout=output,
                        stderr=output,
                        env={**self._variables, results.VARIABLE: str(writable)},
                        pass_fds=[writable],
                        start_new_session=True,
                    )
                except OSError as error:  # an argument that is too long for the system
                    return ProcessResult(_NOT_STARTED, False, f"cannot be started: {error.strerror}", None, 0.0, 0)
                self._running.add(process.pid)
            if has_waitid := hasattr(os, "waitid"):
                # Keep the process ID reserved until it is forgotten, so that stop() never signals another process.
                os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
                self._forget(process.pid)
            _, status, usage = os.wait4(process.pid, 0)
            if not has_waitid:
                self._forget(process.pid)
            result = results.read_result(readable)
        trim_log(log)
        code = process.returncode = os.waitstatus_to_exitcode(status)
        peak = usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024
        exit_code = 128 - code if code < 0 else code
        message, psnr = result.get("error"), result.get("psnr")
        return ProcessResult(
            exit_code,
            exit_code >= 128,
            one_line(message) if isinstance(message, str) else "",
            psnr if isinstance(psnr, float) and math.isfinite(psnr) else None,
            time.perf_counter() - begun,
            peak,
        )

    def _forget(self, leader: int) -> None:
        with self._lock:
            self._running.discard(leader)

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Send this signal to all running processes and to their children."""
        with self._lock:
            self.stopped = True
            for leader in self._running:
                with suppress(ProcessLookupError):
                    os.killpg(leader, number)


def nerfbake_command() -> list[str]:
    """The command that starts this nerfbake. -P ignores a folder `nerfbake` in the working directory."""
    return [sys.executable, "-P", "-m", "nerfbake"]


def _variables(threads: int) -> Mapping[str, str]:
    """The environment of the processes, with the number of threads for each. Variables that the user has set win."""
    bounds = {"NUMBA_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
    return bounds | os.environ | {PARENT: str(os.getpid())}


@contextmanager
def _pipe() -> Iterator[tuple[int, int]]:
    """Open a pipe and return both ends: a non-blocking one to read from, and one for the process to write to."""
    readable, writable = os.pipe()
    os.set_blocking(readable, False)
    try:
        yield readable, writable
    finally:
        os.close(readable)
        os.close(writable)
