"""Batches at length: hundreds of items broken in many ways, random kills, and ten thousand items in a small parent."""

from __future__ import annotations

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from nerfbake import sample_n3tree, save
from nerfbake.cli.main import run
from nerfbake.io.journal import read_journal
from tests.conftest import REPOSITORY
from tests.support.batches import stub

# `nerfbake batch` with a stub in nerfbake's place, which ends with its parent, as nerfbake does; in a process of its
# own, which tells what it took in its last line.
PARENT = r"""
import json, re, resource, sys
from pathlib import Path
from nerfbake.cli.main import run
from nerfbake.jobs import batches
batches.nerfbake_command = lambda: ["setpriv", "--pdeathsig", "TERM", "/bin/sh", sys.argv[1]]
code = run(["batch", *sys.argv[2:]])
used = resource.getrusage(resource.RUSAGE_SELF)
# Not ru_maxrss, which begins with what the process held that started this one.
peak = 1024 * int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])
print(json.dumps([peak, used.ru_utime + used.ru_stime]))
sys.exit(code)
"""
# Holds three times what its input takes, for a while, and says when, and how much its process had at most.
HOLDER = r"""
import os, re, sys, time
from pathlib import Path
source, target = map(Path, sys.argv[2:4])
begin = time.monotonic()
held = b"1" * (3 * source.stat().st_size)
time.sleep(1.2)
peak = 1024 * int(re.search(r"VmHWM:\s+(\d+)", Path("/proc/self/status").read_text())[1])
with open("log", "a") as log:
    log.write(f"{begin} {time.monotonic()} {peak}\n")
target.write_text("done")
"""
LINES = ("--jobs-file", "jobs.txt", "--state", "run", "-q")


def start(folder: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-c", PARENT, str(folder / "stub.sh"), *arguments]
    environment = os.environ | {"PYTHONPATH": str(REPOSITORY)}
    return subprocess.Popen(command, cwd=folder, env=environment, stdout=subprocess.PIPE, text=True)


def prepared(folder: Path, words: list[str]) -> None:
    """Inputs that say what is to become of them, and a line for each."""
    stub(folder)
    (folder / "in").mkdir()
    for number, word in enumerate(words):
        (folder / f"in/{number}").write_text(f"{word}\n{number}\n")
    (folder / "jobs.txt").write_text("".join(f"svo in/{i} out/{i}.svo.pb\n" for i in range(len(words))))


@pytest.mark.long
def test_thirty_items_of_which_ten_are_broken(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Path("in").mkdir()
    save("whole.npz", sample_n3tree(resolution=8, basis="SH1"))
    whole = Path("whole.npz").read_bytes()
    broken = {number: _broken(whole, number // 3) for number in range(1, 30, 3)}
    for number in range(30):
        Path(f"in/{number}.npz").write_bytes(broken.get(number, whole))
    paths = [f"in/{number}.npz" for number in range(30)]
    line = ["batch", "svo {in} out/{stem}.svo.pb", *paths, "--state", "run", "-q", "--report", "report.csv"]
    assert run(line) == 1
    assert run(["svo", "whole.npz", "loop.svo.pb", "-q"]) == 0
    expected = Path("loop.svo.pb").read_bytes()
    written = {path.name: path.read_bytes() for path in Path("out").iterdir()}
    assert written == {f"{number}.svo.pb": expected for number in range(30) if number not in broken}
    assert Path("report.csv").read_text().count(",failed,1,") == 10
    before = Path("run/items.0-of-1.jsonl").stat().st_size
    assert run(line) == 1
    added = Path("run/items.0-of-1.jsonl").read_bytes()[before:].splitlines()
    assert [json.loads(event)["event"] for event in added].count("start") == 10


def _broken(whole: bytes, way: int) -> bytes:
    """Files that are broken in different ways: cut short, changed within, something else."""
    changed = bytes([*whole[: 100 + 40 * way], whole[100 + 40 * way] ^ 0xFF, *whole[101 + 40 * way :]])
    ways = (b"", b"\0" * 50, whole[: len(whole) // 2], whole[:-30], b"PK\x03\x04", whole[::-1])
    return ways[way] if way < len(ways) else whole[: len(whole) - 5 * way] + changed[:1]


@pytest.mark.long
def test_twenty_random_kills_lose_nothing_and_do_nothing_twice(tmp_path: Path) -> None:
    """kill -9 of children, of the parent, or of both, and lines torn: then all is done once, and nothing lies about."""
    count, jobs, kills = 160, 3, 20
    prepared(tmp_path, ["fine"] * count)
    chance = random.Random(16)
    for _ in range(kills):
        parent = start(tmp_path, *LINES, "-j", str(jobs))
        time.sleep(chance.uniform(0.25, 0.6))
        victims = chance.choice(["children", "parent", "both"])
        below = _below(parent.pid)
        if victims != "parent":
            for child in below:
                _kill(child)
        if victims != "children":
            parent.kill()
            if chance.random() < 0.5:
                _tear(tmp_path / "run/items.0-of-1.jsonl", chance)
        else:
            parent.terminate()
        parent.communicate()
    time.sleep(1)  # a copy that has outlived its shell is done by then
    last = start(tmp_path, *LINES, "-j", str(jobs))
    last.communicate()
    failed = [event for event in read_journal(tmp_path / "run/items.0-of-1.jsonl") if event.get("code")]
    assert last.returncode == 0, failed[-3:]
    for number in range(count):
        assert (tmp_path / f"out/{number}.svo.pb").read_text() == f"fine\n{number}\n"
    runs = [len((tmp_path / f"out/{i}.svo.pb.threads").read_text().splitlines()) for i in range(count)]
    assert sum(runs) - count <= (jobs + 1) * kills  # one more for each line that was torn
    left = [path.name for path in (tmp_path / "run").iterdir()]
    assert sorted(left) == ["items.0-of-1.jsonl", "log", "plan.txt"]


def _below(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(word) for task in tasks for word in task.read_text().split()]


def _kill(pid: int) -> None:
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def _tear(journal: Path, chance: random.Random) -> None:
    """What a machine leaves that dies while a line is written.

    A start is on the disk before its child begins: it cannot be torn where there is anything of that child's.
    """
    lines = journal.read_bytes().splitlines(keepends=True) if journal.exists() else []
    if lines and not lines[-1].startswith(b'{"event":"start"'):
        os.truncate(journal, journal.stat().st_size - chance.randint(0, len(lines[-1])))


@pytest.mark.long
def test_a_thousand_items_cost_little(tmp_path: Path) -> None:
    """The parent stays below 100 MB, and an item takes less than 15 ms of its processor."""
    count = 1_000
    prepared(tmp_path, ["fine"] * count)
    parent = start(tmp_path, *LINES, "-j", "2", "--report", "report.html")
    printed, _ = parent.communicate()
    assert parent.returncode == 0
    peak, worked = json.loads(printed.splitlines()[-1])
    print(f"{count:,} items: {1000 * worked / count:.1f} ms of the parent's processor each, {peak / 1e6:.0f} MB")
    assert peak < 100e6
    assert worked / count < 0.015


@pytest.mark.long
def test_what_runs_at_once_stays_within_the_memory_and_what_needs_more_runs_alone(tmp_path: Path) -> None:
    """Peaks of real processes, first by what their inputs make likely, then by what they took the last time.

    The batch is a process of its own: on Linux a child's peak begins with what its parent holds, here all other tests'.
    """
    prepared(tmp_path, ["fine"] * 8)
    (tmp_path / "holder.py").write_text(HOLDER)
    (tmp_path / "stub.sh").write_text(f'exec "{sys.executable}" holder.py "$@"\n')
    for number, size in enumerate([4, 20, 344, 30, 4, 8, 25, 10]):  # MiB; 344 take three times the memory
        os.truncate(tmp_path / f"in/{number}", size << 20)
    for _ in range(2):
        parent = start(tmp_path, *LINES, "-j", "3", "--memory", "512MiB")
        parent.communicate()
        assert parent.returncode == 0
        times = [tuple(map(float, line.split())) for line in (tmp_path / "log").read_text().splitlines()]
        assert len(times) == 8
        at_once = [[peak for begin, end, peak in times if begin <= start < end] for start, _, _ in times]
        (large,) = (peaks for peaks in at_once if max(peaks) > 512 << 20)
        assert len(large) == 1
        assert max(map(len, at_once)) > 1
        assert all(sum(peaks) <= 512 << 20 for peaks in at_once if peaks is not large)
        (tmp_path / "log").unlink()
        for output in (tmp_path / "out").iterdir():
            output.unlink()
