"""What one thread does alone: the stopwatches, and the benchmark on a tiny scene."""

from __future__ import annotations

import subprocess
import sys
import time
from threading import Thread

import pytest

from benchmarks import cores
from benchmarks.alone import SharedWork, Watch
from benchmarks.cores import Command
from benchmarks.scenes import Scenes
from benchmarks.suite import SUITE, run

SECONDS = 0.05


def work() -> None:
    end = time.thread_time() + SECONDS
    while time.thread_time() < end:
        pass


def test_shared_work_of_the_main_thread_counts_once() -> None:
    shared = SharedWork()
    inner = shared.timed(work)
    outer = shared.timed(inner)
    outer()
    assert SECONDS <= shared.seconds < 2 * SECONDS
    other = Thread(target=outer)
    other.start()
    other.join()
    assert shared.seconds < 2 * SECONDS


@pytest.mark.slow
@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="looks into /proc")
def test_a_process_with_one_busy_thread_works_alone() -> None:
    watch = Watch()
    program = "import time\nwhile time.process_time() < 0.7: pass"
    subprocess.run([sys.executable, "-c", program], check=True)
    watch.end()
    assert 0.2 < watch.alone < 0.9


@pytest.mark.long
@pytest.mark.usefixtures("photographed")
def test_the_report_has_a_row_for_each_command_and_number_of_threads(
    scenes: Scenes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cores, "cores", lambda: 2)
    monkeypatch.setattr(cores, "FIT", ("--epochs", "cells=8,epochs=1", "--basis", "SH1"))
    monkeypatch.setattr(cores, "COMMANDS", (Command("info", ("{scene}",)),))
    monkeypatch.setattr(cores, "OPTIONS", ())
    (benchmark,) = (benchmark for benchmark in SUITE if benchmark.name == "cores")
    (text,) = run(benchmark, scenes, rounds=1).values()
    rows = [line.split(" | ") for line in text.decode().splitlines() if line.startswith("| info")]
    assert [row[1].strip() for row in rows] == ["1", "2"]
    assert float(rows[1][-1].strip(" |")) > 50  # reading a small file is serial
