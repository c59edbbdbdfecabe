"""Measure the memory that loading a file or folder takes, for a series of memory limits.

A server process has imported everything; it forks for each path, so that a measurement takes no start of Python. The
peak is the highest resident memory above that before loading. It counts every page of the process, whichever library
allocated it.
"""

from __future__ import annotations

import gc
import json
import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import takewhile
from pathlib import Path

from nerfbake import catalog, io
from nerfbake.errors import MemoryLimit, NerfbakeError
from nerfbake.memory import memory_limit

REPOSITORY = Path(__file__).parents[2]  # tests.conftest would import pytest and Hypothesis in the process
STEP = 1.3  # factor from one limit to the next
LEAST, MOST = 1 << 20, 4 << 30
# The allocator returns freed memory at once, so that each measurement covers one load.
FRUGAL = {"MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072", "OPENBLAS_NUM_THREADS": "1"}


def resident() -> int:
    """Return the resident memory of this process in bytes, and reset peak()."""
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def peak() -> int:
    with open("/proc/self/status") as file:
        return next(int(line.split()[1]) << 10 for line in file if line.startswith("VmHWM"))


class Peaks:
    """The server process."""

    def __init__(self) -> None:
        environment = os.environ | FRUGAL | {"PYTHONPATH": str(REPOSITORY)}
        command = [sys.executable, "-m", "tests.support.peaks"]
        self._server = subprocess.Popen(
            command, cwd=REPOSITORY, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def measured(self, path: Path) -> list[tuple[int, int, bool]]:
        """(limit, peak, refused) for increasing limits, from half the file's size until loading succeeds."""
        assert self._server.stdin
        assert self._server.stdout
        self._server.stdin.write(f"{path}\n")
        self._server.stdin.flush()
        answer = json.loads(self._server.stdout.readline())
        assert isinstance(answer, list), answer
        return [(limit, most, refused) for limit, most, refused in answer]

    def close(self) -> None:
        assert self._server.stdin
        assert self._server.stdout
        self._server.stdin.close()
        self._server.stdout.close()
        self._server.wait()


def _limits(size: int) -> Iterator[int]:
    limit = max(size / 2, LEAST)
    while True:
        yield int(limit)
        limit *= STEP


def _measured(path: Path) -> list[tuple[int, int, bool]]:
    with memory_limit(MOST):
        io.load(path)  # compiles
    found = []
    files = [path] if path.is_file() else [file for file in path.rglob("*") if file.is_file()]
    for limit in takewhile(lambda limit: limit < MOST, _limits(sum(file.stat().st_size for file in files))):
        gc.collect()
        before, refused = resident(), False
        with memory_limit(limit):
            try:
                io.load(path)
            except MemoryLimit:
                refused = True
        found.append((limit, peak() - before, refused))
        if not refused:
            break
    return found


def _answer(path: Path) -> None:
    try:
        answer: object = _measured(path)
    except NerfbakeError as error:
        answer = f"{path} is no sound file: {error}"
    except Exception as error:
        answer = f"{path}: {error!r}"
    print(json.dumps(answer), flush=True)


def main() -> None:
    for form in (*catalog.FORMATS, *catalog.FOLDERS):
        form.load_module()
    gc.freeze()
    for line in sys.stdin:
        if (child := os.fork()) == 0:
            _answer(Path(line.rstrip("\n")))
            os._exit(0)
        os.waitpid(child, 0)


if __name__ == "__main__":
    main()
