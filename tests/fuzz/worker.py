"""Try cases and print one line of JSON per case with its findings: `python -m tests.fuzz.worker SEED STATE`.

The case numbers are read from stdin, one per line. Before each case, the worker writes its number to the file STATE, so
that the main process can tell which case ended a worker.
"""

from __future__ import annotations

import gc
import json
import os
import resource
import shutil
import sys
import tempfile
from dataclasses import asdict
from pathlib import Path

from nerfbake.formats.wire.usd import reading
from tests.fuzz import corpus
from tests.fuzz.breakage import Case, case_of
from tests.fuzz.trial import Finding, Trial
from tests.support.usd import UsdServer

ADDRESS_SPACE = 6 << 30  # bytes: only runaway allocations reach this limit


def tried(case: Case) -> list[Finding]:
    """Try a case in a temporary folder, and return its findings."""
    place = Path(tempfile.mkdtemp(prefix="nerfbake-fuzz-"))
    try:
        return Trial(case, place).run()
    finally:
        shutil.rmtree(place, ignore_errors=True)


def warm_up() -> None:
    """Try every valid file once, so that imports and compilation on first use are not measured in cases."""
    for form in corpus.names():
        for content in corpus.sound(form):
            for finding in tried(Case(-1, form, f"case.{form}", content)):
                if "s of CPU" not in finding.what and "MiB" not in finding.what:
                    raise AssertionError(f"a sound file of {form}: {finding}")


def main(seed: int, state: Path) -> None:
    server = UsdServer()
    reading.exchange = server.exchange
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    warm_up()
    with open(state, "r+b", buffering=0) as file:
        for line in sys.stdin:
            number = int(line)
            os.pwrite(file.fileno(), number.to_bytes(8, "little"), 0)
            found = tried(case_of(seed, number))
            print(json.dumps({"case": number, "findings": [asdict(each) for each in found]}), flush=True)
            if number % 64 == 0:
                gc.collect()


if __name__ == "__main__":
    main(int(sys.argv[1]), Path(sys.argv[2]))
