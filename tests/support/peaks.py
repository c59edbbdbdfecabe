"""Measure the memory that loading a file takes, for a series of memory limits: `python -m tests.support.peaks FILE`.

Prints a list of [limit, peak, refused], in bytes. The peak is the highest resident memory above that before loading,
after all imports. It counts every page of the process, whichever library allocated it.
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

from nerfbake import io
from nerfbake.errors import MemoryLimit, NerfbakeError
from nerfbake.memory import memory_limit

REPOSITORY = Path(__file__).parents[2]  # tests.conftest would import pytest and Hypothesis in every process
STEP = 1.3  # factor from one limit to the next
MOST = 4 << 30
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


def measured(path: Path) -> list[tuple[int, int, bool]]:
    """(limit, peak, refused) for increasing limits, from half the file's size until loading succeeds."""
    environment = os.environ | FRUGAL | {"PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, "-m", "tests.support.peaks", str(path)]
    done = subprocess.run(command, cwd=REPOSITORY, env=environment, capture_output=True, check=True)
    return [(limit, most, refused) for limit, most, refused in json.loads(done.stdout)]


def _limits(size: int) -> Iterator[int]:
    limit = size / 2
    while True:
        yield int(limit)
        limit *= STEP


def main(path: Path) -> None:
    with memory_limit(MOST):
        io.load(path)  # imports and compiles
    found = []
    for limit in takewhile(lambda limit: limit < MOST, _limits(path.stat().st_size)):
        gc.collect()
        before, refused = resident(), False
        with memory_limit(limit):
            try:
                io.load(path)
            except MemoryLimit:
                refused = True
            except NerfbakeError as error:
                raise AssertionError(f"{path} is no sound file") from error
        found.append((limit, peak() - before, refused))
        if not refused:
            break
    print(json.dumps(found))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
