"""Run many cases in worker processes, and watch these processes."""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from itertools import count, islice
from pathlib import Path
from typing import Any

from tests.conftest import REPOSITORY
from tests.fuzz import corpus
from tests.fuzz.trial import Finding

SILENCE = 120.0  # seconds without output after which a process counts as hanging
COMMAND = [sys.executable, "-m", "tests.fuzz.worker"]
_AHEAD = 4  # cases in the queue of a process
# The allocator returns freed memory at once, so that peaks are those of one case. One BLAS thread per process.
_ENVIRONMENT = {"MALLOC_MMAP_THRESHOLD_": "131072", "MALLOC_TRIM_THRESHOLD_": "131072", "OPENBLAS_NUM_THREADS": "1"}


@dataclass
class Result:
    """The number of cases by format, and the findings."""

    tried: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)

    def by_key(self) -> dict[str, list[Finding]]:
        groups: dict[str, list[Finding]] = {}
        for finding in self.findings:
            groups.setdefault(finding.key, []).append(finding)
        return groups


class _Worker:
    """A process that tries cases. given: the cases in its queue."""

    def __init__(self, seed: int, folder: Path) -> None:
        state, name = tempfile.mkstemp(dir=folder)
        os.pwrite(state, b"\xff" * 8, 0)
        self._state, self.given = state, list[int]()
        environment = os.environ | _ENVIRONMENT | {"PYTHONPATH": str(REPOSITORY), "TMPDIR": str(folder)}
        self._process = subprocess.Popen(
            [*COMMAND, str(seed), name], stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=REPOSITORY, env=environment
        )
        assert self._process.stdin
        assert self._process.stdout
        self._stdin, self.stdout = self._process.stdin, self._process.stdout
        self.heard, self._rest = time.monotonic(), b""

    @property
    def at(self) -> int:
        """The number of its current or last case."""
        return int.from_bytes(os.pread(self._state, 8, 0), "little")

    def give(self, number: int) -> None:
        self.given.append(number)
        with suppress(BrokenPipeError):  # it has died; read() reports that
            self._stdin.write(b"%d\n" % number)
            self._stdin.flush()

    def read(self) -> list[dict[str, Any]] | None:
        """The results that it has printed since the last call; None after its end."""
        data = os.read(self.stdout.fileno(), 1 << 16)
        self.heard = time.monotonic()
        *lines, self._rest = (self._rest + data).split(b"\n")
        return [json.loads(line) for line in lines] if data else None

    def end(self) -> int:
        self._process.kill()
        code = self._process.wait()
        with suppress(BrokenPipeError):
            self._stdin.close()
        self.stdout.close()
        os.close(self._state)
        return code


def numbers(form: str | None, first: int = 0) -> Iterator[int]:
    """The case numbers of a format, or of all formats in turn."""
    names = corpus.names()
    return count(first) if form is None else count(first - first % len(names) + names.index(form), len(names))


def campaign(
    seed: int, *, jobs: int = 2, cases: int | None = None, seconds: float | None = None, form: str | None = None
) -> Iterator[Result]:
    """Try a number of cases, or run for a time. Yields the result so far repeatedly, and the full result at the end."""
    result, deadline = Result(), time.monotonic() + (seconds or 1e9)
    wanted = islice(numbers(form), cases)
    with tempfile.TemporaryDirectory(prefix="nerfbake-fuzz-") as name:
        folder, selector = Path(name), selectors.DefaultSelector()
        workers = set[_Worker]()

        def start(given: list[int]) -> None:
            worker = _Worker(seed, folder)
            workers.add(worker)
            selector.register(worker.stdout, selectors.EVENT_READ, worker)
            for number in given:
                worker.give(number)
            feed(worker)

        def feed(worker: _Worker) -> None:
            while len(worker.given) < _AHEAD and time.monotonic() < deadline:
                if (number := next(wanted, None)) is None:
                    return
                worker.give(number)

        def end(worker: _Worker, why: str) -> None:
            """End a worker. If cases remain, record its current case as a finding and give the rest to a new worker."""
            selector.unregister(worker.stdout)
            workers.discard(worker)
            at, code = worker.at, worker.end()
            if not worker.given:
                return
            if at not in worker.given:
                raise RuntimeError(f"a process ended with code {code} before its first case")
            result.findings.append(Finding(at, _form(at), "", f"{why} (exit code {code})"))
            start([number for number in worker.given if number != at])

        try:
            for _ in range(jobs):
                start([])
            while workers:
                for key, _ in selector.select(timeout=1.0):
                    worker: _Worker = key.data
                    if (said := worker.read()) is None:
                        end(worker, "the process dies")
                        continue
                    for each in said:
                        worker.given.remove(each["case"])
                        name = _form(each["case"])
                        result.tried[name] = result.tried.get(name, 0) + 1
                        result.findings += [Finding(**finding) for finding in each["findings"]]
                    feed(worker)
                    if not worker.given:
                        end(worker, "")
                for worker in list(workers):
                    if time.monotonic() - worker.heard > SILENCE:
                        end(worker, f"says nothing for {SILENCE:g} s")
                yield result
        finally:
            for worker in workers:
                worker.end()
    yield result


def _form(number: int) -> str:
    return corpus.names()[number % len(corpus.names())]
