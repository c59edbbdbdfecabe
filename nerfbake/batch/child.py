"""One item in a process of its own: what it said, what it took, how it ended.

The item's own process group keeps the terminal's Ctrl-C away from it: whoever runs the batch decides when it stops. On
Linux it gets SIGTERM when its parent dies, whatever killed that.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

from nerfbake.errors import one_line
from nerfbake.io.logs import end_of_log, opened_log

PARENT = "NERFBAKE_BATCH"  # the variable that tells a child whose it is
_NOT_STARTED = 126  # as a shell says it
_PSNR = re.compile(r"(-?\d+\.\d+) dB(?:, SSIM [\d.]+)? (?:against|on) ")


class Ended(NamedTuple):
    """How a process ended.

    code     its exit code; 128 and the signal's number where one killed it
    killed   it did not end by itself
    error    the last line that begins with `error: `, without that
    psnr     the last that it told of what it had written, in dB
    """

    code: int
    killed: bool
    error: str
    psnr: float | None
    seconds: float
    peak: int


class Children:
    """The processes that run now. After stop() there are soon none, and no others start."""

    def __init__(self, command: Sequence[str], threads: int) -> None:
        self._command, self._variables = list(command), _variables(threads)
        self._running: set[int] = set()
        self._lock, self.stopped = threading.Lock(), False

    def run(self, argv: Sequence[str], log: Path) -> Ended | None:
        """Runs a command line to its end. None after stop(). Raises OutputError where its words cannot be kept."""
        begun = time.perf_counter()
        with opened_log(log) as words:
            with self._lock:
                if self.stopped:
                    return None
                try:
                    process = subprocess.Popen(
                        [*self._command, *argv],
                        stdin=subprocess.DEVNULL,
                        stdout=words,
                        stderr=words,
                        env=self._variables,
                        start_new_session=True,
                    )
                except OSError as error:  # a word that is too long for the system
                    return Ended(_NOT_STARTED, False, f"cannot be started: {error.strerror}", None, 0.0, 0)
                self._running.add(process.pid)
            if hasattr(os, "waitid"):  # its number is its own until it is reaped, so that nobody else is ever killed
                os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)
            with self._lock:
                self._running.discard(process.pid)
            _, status, usage = os.wait4(process.pid, 0)
        code = process.returncode = os.waitstatus_to_exitcode(status)
        peak = usage.ru_maxrss if sys.platform == "darwin" else usage.ru_maxrss * 1024
        said = end_of_log(log)
        shown = 128 - code if code < 0 else code
        return Ended(shown, shown >= 128, _error(said), _psnr(said), time.perf_counter() - begun, peak)

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Sends this signal to each of them, and to what they have started."""
        with self._lock:
            self.stopped = True
            for leader in self._running:
                with suppress(ProcessLookupError):
                    os.killpg(leader, number)


def nerfbake_command() -> list[str]:
    """What starts nerfbake as it runs here; a folder of that name where we stand is not meant."""
    return [sys.executable, "-P", "-m", "nerfbake"]


def _variables(threads: int) -> Mapping[str, str]:
    """The environment, where all items together use as many threads as there are cores, unless somebody says more."""
    bounds = {"NUMBA_NUM_THREADS": str(threads), "OMP_NUM_THREADS": str(threads)}
    return bounds | os.environ | {PARENT: str(os.getpid())}


def _error(said: str) -> str:
    lines = [line for line in said.splitlines() if line.startswith("error: ")]
    return one_line(lines[-1].removeprefix("error: ")) if lines else ""


def _psnr(said: str) -> float | None:
    found = _PSNR.findall(said)
    return float(found[-1]) if found else None
