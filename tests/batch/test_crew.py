"""Batches of a stub: what is run, what is run again, what is told, and what happens when somebody is killed."""

from __future__ import annotations

import os
import shutil
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from nerfbake.batch import crew
from nerfbake.batch.crew import MemoryQueue
from nerfbake.batch.items import Item
from nerfbake.batch.state import State
from nerfbake.errors import OutputError, UsageError
from nerfbake.jobs import Batch, BatchOptions, run_batch


def item(word: str, name: str = "a", **more: Any) -> Item:
    """An item whose input says what becomes of it."""
    path = Path("in") / name
    path.write_text(f"{word}\n{name}\n")
    more = {"spare": (f"out/{name}.rejected",)} | more
    return Item(("svo", str(path), f"out/{name}"), (str(path),), (f"out/{name}",), **more)


def run(items: list[Item], report_to: str | None = None, **how: Any) -> Batch:
    return run_batch(items, state="run", run=BatchOptions(**{"jobs": 2, **how}), report_to=report_to)


def statuses(batch: Batch) -> list[str]:
    return [row.status for row in batch.rows]


@pytest.mark.parametrize(
    ("word", "status", "code", "error"),
    [
        ("fine", "done", 0, ""),
        ("broken", "failed", 1, "in/a: is broken"),
        ("usage", "failed", 2, "no such option"),
        ("poor", "rejected", 3, "out/a: has a mean PSNR of 20.00 dB"),
        ("full", "failed", 4, "out/a: No space left on device"),
        ("fault", "failed", 70, "a fault of nerfbake's own"),
        ("killed", "killed", 137, "was killed (exit 137)"),
        ("silent", "failed", 0, "out/a: was not written, although the command succeeded"),
    ],
)
def test_what_becomes_of_an_item(folder: Path, word: str, status: str, code: int, error: str) -> None:
    batch = run([item(word)])
    attempt = batch.rows[0].attempt
    assert attempt is not None
    assert (attempt.status, attempt.code, attempt.error) == (status, code, error)
    assert [output.path for output in attempt.outputs] == {"done": ["out/a"], "rejected": ["out/a.rejected"]}.get(
        status, []
    )
    assert batch.exit_code == {"done": 0, "rejected": 3}.get(status, 1)
    assert not Path("run/lock.0-of-1").exists()


def test_what_was_rejected_is_rejected_again_and_somebody_elses_file_is_kept(folder: Path) -> None:
    for _ in range(2):
        assert statuses(run([item("poor")])) == ["rejected"]
    assert statuses(run([item("fine")])) == ["done"]
    assert statuses(run([item("fine", "b")])) == ["done"]
    Path("out/b.rejected").write_text("mine")  # the batch has recorded none
    assert statuses(run([item("poor", "b")])) == ["failed"]
    assert Path("out/b.rejected").read_text() == "mine"
    assert Path("out/b").read_text() == "fine\nb\n"


def test_a_bad_item_costs_itself_alone_and_only_it_is_run_again(folder: Path) -> None:
    words = ["fine", "broken", "poor", "killed", "fine"]
    items = [item(word, name) for word, name in zip(words, "abcde", strict=True)]
    first = run(items)
    assert statuses(first) == ["done", "failed", "rejected", "killed", "done"]
    assert (first.ran, first.exit_code) == (5, 1)
    again = run(items)
    assert (again.ran, again.exit_code, statuses(again)) == (3, 1, statuses(first))
    for name in "bcd":
        item("fine", name)
    assert (run(items).ran, run(items).ran) == (3, 0)
    assert [Path(f"out/{name}").read_text() for name in "abcde"] == [f"fine\n{name}\n" for name in "abcde"]
    assert sorted(path.name for path in Path("out").iterdir() if path.suffix == ".part") == []


def test_what_was_deleted_cut_short_or_edited_is_made_again_and_what_was_touched_is_not(folder: Path) -> None:
    items = [item("fine", name) for name in "abcd"]
    run(items)
    Path("out/a").unlink()
    Path("out/b").write_text("half")
    Path("in/c").write_text("fine\nC\n")
    os.utime("in/d", (1, 1))
    again = run(items)
    assert (again.ran, again.exit_code) == (3, 0)
    assert Path("out/c").read_text() == "fine\nC\n"  # it replaced an output that the state knows


def test_an_output_that_the_state_does_not_know_is_left_alone(folder: Path) -> None:
    Path("out").mkdir()
    Path("out/a").write_text("somebody's")
    for _ in range(2):
        batch = run([item("fine")])
        assert batch.rows[0].attempt is not None
        assert batch.rows[0].attempt.error == "out/a: exists already"
    assert Path("out/a").read_text() == "somebody's"


def test_what_was_written_and_not_recorded_is_made_again(folder: Path) -> None:
    run([item("fine")])
    journal = Path("run/items.0-of-1.jsonl")
    whole = journal.read_bytes().splitlines(keepends=True)
    journal.write_bytes(b"".join(whole[:-1]) + whole[-1][:40])  # the parent died while it wrote the end
    again = run([item("fine")])
    assert (again.ran, again.exit_code) == (1, 0)
    assert run([item("fine")]).ran == 0


@pytest.mark.parametrize(("word", "tries"), [("killed", 3), ("full", 3), ("broken", 1), ("poor", 1), ("once", 2)])
def test_only_what_may_go_better_is_tried_again(folder: Path, word: str, tries: int) -> None:
    attempt = run([item(word)], retries=2).rows[0].attempt
    assert attempt is not None
    assert attempt.number == tries


def test_fail_fast_starts_no_more(folder: Path) -> None:
    items = [item("broken"), *(item("fine", name) for name in "bcd")]
    batch = run(items, jobs=1, fail_fast=True)
    assert statuses(batch) == ["failed", "waiting", "waiting", "waiting"]
    assert batch.exit_code == 1


def test_shards_in_any_order_and_at_once_are_one_batch(folder: Path) -> None:
    items = [item("broken" if name == "e" else "fine", name) for name in "abcdefg"]
    threads = [threading.Thread(target=run, args=(items,), kwargs={"shard": (i, 3), "jobs": 1}) for i in (2, 0, 1)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    merged = run_batch(items, state="run", run=None)
    assert (statuses(merged), merged.exit_code, merged.ran) == (["done"] * 4 + ["failed"] + ["done"] * 2, 1, 0)
    assert run(items).ran == 1  # in one piece: what shards have done is done
    shutil.rmtree("out")
    shutil.rmtree("run")
    assert told(run(items)) == told(merged)


def told(batch: Batch) -> list[list[Any]]:
    """What a batch reports but for times and memory."""
    rows = [row.attempt for row in batch.rows]
    return [[each.status, each.code, each.error, each.read, each.outputs, each.psnr] for each in rows if each]


def test_a_second_batch_on_the_same_shard_is_refused_until_it_takes_over(folder: Path) -> None:
    Path("run").mkdir()
    Path("run/lock.0-of-1").write_text('{"pid": 4000000, "host": "elsewhere"}')
    with pytest.raises(OutputError) as caught:
        run([item("fine")])
    said = "is in use by process 4000000 on elsewhere; allowed: to wait for it, or `take_over`"
    assert str(caught.value) == f"run/lock.0-of-1: {said}"
    assert not Path("out").exists()
    assert run([item("fine")], take_over=True).exit_code == 0
    assert not Path("run/lock.0-of-1").exists()


def test_a_state_that_cannot_be_written_ends_the_batch(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    real, written = os.fsync, []

    def full(handle: int) -> None:
        written.append(handle)
        if len(written) > 3:
            raise OSError(28, "No space left on device")
        real(handle)

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OutputError, match=r"items.0-of-1.jsonl: No space left on device"):
        run([item("fine", name) for name in "abcdef"], jobs=1)
    assert not Path("run/lock.0-of-1").exists()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_what_runs_and_the_state_says_so(folder: Path, number: int) -> None:
    items = [item("slow"), item("slow", "b"), item("fine", "c")]

    def interrupt() -> None:
        while not (Path("out/a.begun").exists() and Path("out/b.begun").exists()):
            time.sleep(0.01)
        os.kill(os.getpid(), number)

    threading.Thread(target=interrupt).start()
    before = signal.getsignal(number)
    batch = run(items)
    assert signal.getsignal(number) == before
    assert (batch.exit_code, statuses(batch)) == (128 + number, ["killed", "killed", "waiting"])
    merged = run_batch(items, state="run", run=None)
    assert (statuses(merged), merged.exit_code) == (["killed", "killed", "waiting"], 1)


def test_a_child_that_does_not_listen_is_killed(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crew, "PATIENCE", 0.1)
    deaf = item("slow")
    stub = folder / "stub.sh"
    stub.write_text(stub.read_text().replace("trap 'exit 143' TERM; sleep 60 & wait", "trap '' TERM; sleep 60"))

    def interrupt() -> None:
        while not Path("out/a.begun").exists():
            time.sleep(0.01)
        os.kill(os.getpid(), signal.SIGTERM)

    threading.Thread(target=interrupt).start()
    attempt = run([deaf]).rows[0].attempt
    assert attempt is not None
    assert (attempt.status, attempt.code) == ("killed", 137)


def test_children_share_the_cores(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.jobs.batches.cores", lambda: 8)
    for name in ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS"):
        monkeypatch.delenv(name, raising=False)
    run([item("fine")], jobs=3)
    assert Path("out/a.threads").read_text() == "2\n"


def test_an_item_that_needs_more_than_all_memory_runs_alone_and_others_fit() -> None:
    room, most, lock = MemoryQueue(100), [0, 0], threading.Lock()
    running: list[int] = []

    def work(need: int) -> None:
        with room.taken(need):
            with lock:
                running.append(need)
                most[need > 100] = max(most[need > 100], sum(running))
            time.sleep(0.01)
            with lock:
                running.remove(need)

    threads = [threading.Thread(target=work, args=(need,)) for need in (40, 300, 40, 50, 60, 300, 30, 20)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert most[1] == 300
    assert 60 <= most[0] <= 100


def test_an_estimate_is_the_last_peak_or_what_the_arrays_of_an_input_take(folder: Path) -> None:
    import numpy as np

    np.savez_compressed("a.npz", a=np.zeros(1 << 20, np.uint8))
    room, what = MemoryQueue(1 << 40), Item(("svo",), reads=("a.npz",))
    assert 4 << 20 <= room.estimate(what, 0) - room.estimate(Item(()), 0) < (4 << 20) + 4096
    assert room.estimate(what, 7) == 7
    assert MemoryQueue(None).estimate(what, 0) == 0


def test_a_log_keeps_the_end_of_what_was_printed(folder: Path) -> None:
    stub = folder / "stub.sh"
    stub.write_text('#!/bin/sh\nhead -c 200000 /dev/zero | tr "\\0" x\necho\necho "error: at last" >&2\nexit 1\n')
    run([item("fine")])
    (log,) = Path("run/log").iterdir()
    assert log.stat().st_size == 64 << 10
    assert log.read_text().endswith("x\nerror: at last\n")


@pytest.mark.parametrize(
    ("lines", "psnr", "error"),
    [
        ('{"psnr": 30.5}\n{"error": "late"}\n', 30.5, "late"),
        ('{"psnr": 1.0}\n{"psnr": 2.0}\n', 2.0, ""),
        ('{"psnr": NaN}\n{"psnr', None, ""),
        ('[1]\nno JSON\n{"psnr": "30 dB", "error": 3}\n', None, ""),
        ("", None, ""),
    ],
)
def test_a_result_is_what_was_reported_last(folder: Path, lines: str, psnr: float | None, error: str) -> None:
    (folder / "lines").write_text(lines)
    (folder / "stub.sh").write_text(
        '#!/bin/sh\ncat lines > "/dev/fd/$NERFBAKE_RESULT"\necho "9.99 dB against"\nexit 1\n'
    )
    attempt = run([item("fine")]).rows[0].attempt
    assert attempt is not None
    assert (attempt.psnr, attempt.error) == (psnr, error)


def test_a_process_that_outlives_its_command_does_not_hold_the_batch(folder: Path) -> None:
    (folder / "stub.sh").write_text("#!/bin/sh\nsleep 30 &\nexit 1\n")
    begun = time.monotonic()
    run([item("fine")])
    assert time.monotonic() - begun < 15


def test_a_shard_that_there_is_not_is_refused(folder: Path) -> None:
    with pytest.raises(UsageError, match="allowed: 0/3 to 2/3"):
        run([item("fine")], shard=(3, 3))
    with pytest.raises(UsageError, match="`shard` is 0/0; allowed: I/N, with N of 1 or more"):
        run([item("fine")], shard=(0, 0))
    with pytest.raises(UsageError, match="allowed: 1 or more"):
        run([item("fine")], jobs=0)


def test_a_word_too_long_for_the_system_costs_its_item_alone(folder: Path) -> None:
    items = [item("fine", "a"), item("fine", "b")]
    batch = run([items[0]._replace(argv=(*items[0].argv, "x" * (1 << 18))), items[1]])
    assert batch.rows[0].attempt is not None
    assert batch.rows[0].attempt.code == 126
    assert batch.rows[0].attempt.error == "cannot be started: Argument list too long"
    assert statuses(batch) == ["failed", "done"]


def test_a_word_with_a_nul_is_refused_before_anything_runs(folder: Path) -> None:
    with pytest.raises(UsageError, match="has a NUL; allowed: arguments and paths without one"):
        run([item("fine", "a"), Item(("info", "a\0b"))])
    assert not Path("run").exists()


@pytest.mark.parametrize("place", ["log/ID", "log", "items.0-of-1.jsonl", "plan.txt", "lock.0-of-1", "reports.jsonl"])
def test_a_link_in_the_state_folder_is_not_followed(folder: Path, place: str) -> None:
    """Nothing outside the folder is written, whatever somebody has put into it."""
    outside = folder / "outside"
    outside.mkdir()
    (outside / "mine").write_text("mine")
    what = item("fine")
    state = State("run")
    link = Path("run") / place.replace("ID", state.identify(what).id)
    link.parent.mkdir(parents=True)
    link.symlink_to(outside if place == "log" else outside / "mine")
    if place == "log/ID":
        assert run([what]).exit_code == 0
        assert not link.is_symlink()
    else:
        with pytest.raises(OutputError, match="is a symbolic link; allowed"):
            run([what], report_to="report.md")
    assert {path.name: path.read_text() for path in outside.iterdir()} == {"mine": "mine"}
