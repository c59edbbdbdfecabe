"""Time and peak memory of a command, from its start to its end: what somebody who types it waits for.

The operating system counts the memory of whoever starts a process as the first memory of that process. A small process
of our own therefore stands between, whatever the benchmark itself holds.
"""

from __future__ import annotations

import atexit
import os
import shutil
import subprocess
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path

from nerfbake.bench.measure import Result, Work, measure, resident_bytes
from nerfbake.errors import NerfbakeError


def measure_process(*command: str | Path, environment: Mapping[str, str] | None = None, keep: bool = False) -> Result:
    """What the command cost; peak: all memory that its process held at most, the interpreter's included.

    environment: variables beside our own. keep: facts["stdout"] is what it printed there. Raises NerfbakeError with
    the command's last words if it fails.
    """
    variables = {**_compiled_modules(), **(environment or {})}
    result = measure(running, command=[str(word) for word in command], environment=variables, keep=keep)
    if result.error:
        raise NerfbakeError(result.error)
    return result._replace(peak=result.facts["peak"])


def running(command: list[str], environment: dict[str, str], keep: bool) -> Work:
    """The work of running the command, what it prints thrown away, or kept; in a process of its own."""

    def run() -> tuple[int, str]:
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
            return resident_bytes(usage), printed.read().decode()

    return Work(run, lambda found: dict(zip(("peak", "stdout"), found, strict=True)))


@cache
def _compiled_modules() -> dict[str, str]:
    """Variables that name a folder where Python keeps what it has compiled, as an installation has it: once a command
    has run, its modules are there.
    """
    folder = tempfile.mkdtemp(prefix="nerfbake-bench-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    return {"PYTHONDONTWRITEBYTECODE": "", "PYTHONPYCACHEPREFIX": folder}
