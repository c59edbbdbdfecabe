from __future__ import annotations

import multiprocessing
import os
import signal
import subprocess
import sys
import weakref
from collections.abc import Iterator
from functools import partial
from threading import Barrier, Event, Thread, active_count, current_thread, main_thread
from time import sleep

import numpy as np
import pytest

from nerfbake import memory, progress
from nerfbake.kernels import parallel
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.jit import compiled, next_task, part_of


@pytest.mark.parametrize("count", [0, 1, 7, 100])
@pytest.mark.parametrize("cores", [1, 3])
def test_every_chunk_is_worked_once(count: int, cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: cores)
    done = np.zeros(count, int)

    def work(begin: int, end: int) -> None:
        assert 0 < end - begin <= 7
        done[begin:end] += 1

    parallel.over_chunks(work, count, 7)
    assert (done == 1).all()


@pytest.mark.parametrize(("asked", "found"), [("3", 3), ("0", 1), ("", None), ("many", None)])
def test_the_cores_are_those_of_the_process_unless_fewer_are_asked_for(
    asked: str, found: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", asked)
    assert parallel.cores() == (found or len(os.sched_getaffinity(0)))


@pytest.mark.parametrize("count", [0, 1, 7, 100])
@pytest.mark.parametrize("cores", ["1", "3", "8"])
def test_the_cores_share_tasks_and_rows(count: int, cores: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", cores)
    tasks, rows, took = np.zeros(count, int), np.zeros(count, int), np.zeros(int(cores), int)
    _do(tasks, rows, took=took)
    assert (tasks == 1).all()
    assert (rows == 1).all()
    assert took.min() == count // len(took)
    assert took.max() == -(-count // len(took))


@parallel.on_every_core
@compiled()
def _do(core: int, cores: int, tasks: Ints, rows: Ints, took: Ints) -> None:
    for task in range(core, len(tasks), cores):
        tasks[task] += 1
    begin, end = part_of(len(rows), core, cores)
    rows[begin:end] += 1
    took[core] = end - begin


@pytest.mark.parametrize("count", [0, 1, 7, 1000])
@pytest.mark.parametrize("cores", ["1", "3", "8"])
def test_each_task_is_taken_once(count: int, cores: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_NUM_THREADS", cores)
    tasks = np.zeros(count, int)
    _take(tasks)
    assert (tasks == 1).all()


@parallel.taken_in_turn
@compiled()
def _take(turn: Ints, tasks: Ints) -> None:
    while True:
        task = next_task(turn)
        if task >= len(tasks):
            break
        tasks[task] += 1


def test_an_error_in_any_thread_is_raised_and_the_pool_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)

    def work(begin: int, end: int) -> None:
        if begin == 30:
            raise ValueError(f"{begin} to {end}")

    for _ in range(20):
        with pytest.raises(ValueError, match="30 to 40"):
            parallel.over_chunks(work, 100, 10)
    assert _sum_of_parts(1000) == sum(range(1000))


def _sum_of_parts(count: int) -> int:
    found = np.zeros(count, int)

    def work(begin: int, end: int) -> None:
        found[begin:end] = range(begin, end)

    parallel.over_chunks(work, count, 7)
    return int(found.sum())


def test_no_thread_works_on_after_an_error_or_ctrl_c(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 2)
    both, ended = Barrier(2), Event()

    def work(begin: int, _: int) -> None:
        if current_thread() is not main_thread():
            both.wait(10)
            sleep(0.05)
            ended.set()
        elif not ended.is_set():
            both.wait(10)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        parallel.over_chunks(work, 2, 1)
    assert ended.is_set()
    assert _helped_by_threads(0)


def test_ctrl_c_while_the_other_threads_finish_is_raised_after_them(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 2)
    both, ended = Barrier(2), Event()

    def work(begin: int, _: int) -> None:
        both.wait(10)
        if current_thread() is not main_thread():
            sleep(0.02)
            os.kill(os.getpid(), signal.SIGINT)
            sleep(0.05)
            ended.set()

    with pytest.raises(KeyboardInterrupt):
        parallel.over_chunks(work, 2, 1)
    assert ended.is_set()


def test_loops_within_loops_and_beside_each_other_end(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    expected, found = _sum_of_parts(100), list[int]()

    def outer(begin: int, end: int) -> None:
        for _ in range(begin, end):
            found.extend(parallel.prefetched(_sum_of_parts(100) for _ in range(3)))

    others = [Thread(target=parallel.over_chunks, args=(outer, 20, 1)) for _ in range(3)]
    for thread in others:
        thread.start()
    for thread in others:
        thread.join(30)
        assert not thread.is_alive()
    assert found == [expected] * 180


def test_other_threads_have_the_callers_memory_limit_and_report_no_progress(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    all_here, found, heard = Barrier(3), list[int](), list[float]()

    def work(begin: int, end: int) -> None:
        with memory.scope():
            memory.hold("a part", 100)
            all_here.wait(10)
            found.append(memory.left())
            all_here.wait(10)
        if current_thread() is not main_thread():
            progress.report(0.5)

    with progress.listening(lambda share, _: heard.append(share)), memory.memory_limit(1 << 40):
        parallel.over_chunks(work, 3, 1)
        assert memory.left() == 1 << 40
        assert memory.left() == next(parallel.in_order([memory.left]))
    assert found == [(1 << 40) - 300] * 3
    assert heard == []
    assert memory.left() == memory.DEFAULT


def test_the_threads_stay(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    _sum_of_parts(100)
    before = active_count()
    for _ in range(50):
        _sum_of_parts(100)
    assert active_count() == before


def test_the_pool_keeps_nothing_of_a_loop_that_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)

    class Large:
        def work(self, begin: int, end: int) -> None:
            """Do nothing."""

        def hear(self, share: float, detail: str) -> None:
            """Do nothing."""

    for _ in range(50):
        large = Large()
        freed = weakref.ref(large)
        with progress.listening(large.hear):
            parallel.over_chunks(large.work, 2, 1)
        del large
        assert freed() is None


def test_without_further_threads_the_caller_does_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    def refused(self: Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(parallel, "_pool", parallel._Pool())
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    monkeypatch.setattr(Thread, "start", refused)
    assert _sum_of_parts(100) == sum(range(100))
    assert list(parallel.prefetched([_sum_of_parts(10), 2])) == [45, 2]


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a fork")
def test_the_child_of_a_fork_has_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    expected = _sum_of_parts(1000)
    with multiprocessing.get_context("fork").Pool(2) as pool:
        assert pool.map_async(_sum_of_parts, [1000] * 4).get(30) == [expected] * 4
        assert pool.map_async(_helped_by_threads, [0]).get(30) == [True]
    assert _sum_of_parts(1000) == expected


@pytest.mark.skipif(not hasattr(os, "fork"), reason="a fork")
def test_a_fork_while_all_threads_are_busy_has_threads_of_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 2)
    begun, over = Event(), Event()

    def items() -> Iterator[int]:
        yield 0
        begun.set()
        over.wait(30)
        yield 1

    ahead = parallel.prefetched(items())
    assert next(ahead) == 0
    assert begun.wait(10)
    with multiprocessing.get_context("fork").Pool(1) as pool:
        assert pool.map_async(_helped_by_threads, [0]).get(30) == [True]
    assert _sum_of_parts(100) == sum(range(100))  # nobody helps
    over.set()
    assert list(ahead) == [1]


def _helped_by_threads(_: int) -> bool:
    """Return whether two threads work at the same time."""
    both = Barrier(2)

    def meet(begin: int, end: int) -> None:
        both.wait(10)

    parallel.over_chunks(meet, 2, 1)
    return True


def test_a_process_ends_when_the_item_that_is_made_ahead_is_there() -> None:
    program = (
        "from nerfbake.kernels import parallel\n"
        "from time import sleep\n"
        "ahead = parallel.prefetched(sleep(0.1) or print(item) for item in range(3))\n"
        "next(ahead)\n"
        "parallel.over_chunks(lambda *_: None, 5, 1)\n"
        "keep = [ahead]; keep.append(keep)\n"
    )
    environment = {**os.environ, "NUMBA_NUM_THREADS": "2"}
    found = subprocess.run([sys.executable, "-c", program], env=environment, timeout=30, capture_output=True)
    assert (found.returncode, found.stdout, found.stderr) == (0, b"0\n1\n", b"")


def test_items_made_ahead_come_in_order_with_the_error_behind_them() -> None:
    def items() -> Iterator[int]:
        yield from range(5)
        raise ValueError("behind 4")

    seen: list[int] = []
    with pytest.raises(ValueError, match="behind 4"):
        seen.extend(parallel.prefetched(items()))
    assert seen == [0, 1, 2, 3, 4]
    assert list(parallel.prefetched([])) == []


def test_no_more_than_one_item_is_made_ahead() -> None:
    made = []

    def items() -> Iterator[int]:
        for item in range(100):
            made.append(item)
            yield item

    ahead = parallel.prefetched(items())
    assert [next(ahead), next(ahead)] == [0, 1]
    ahead.close()
    assert made in ([0, 1], [0, 1, 2])


def test_a_thread_that_collects_the_generator_it_works_for_does_not_wait_for_itself(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(parallel, "cores", lambda: 2)
    begun, dropped, ended = Event(), Event(), Event()

    def make() -> Iterator[int]:
        yield 0
        begun.set()
        dropped.wait()
        del cycle[:]  # the last reference, as the garbage collector would find it in this thread
        ended.set()
        yield 1

    cycle = [parallel.prefetched(make())]
    assert next(cycle[0]) == 0
    begun.wait()
    dropped.set()
    assert ended.wait(5)
    assert _helped_by_threads(0)


@pytest.mark.parametrize("cores", [1, 2, 5])
@pytest.mark.parametrize("most", [None, 0, 2])
def test_results_come_in_order_and_few_at_once(cores: int, most: int | None, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: cores)
    begun: list[int] = []

    def work(number: int) -> int:
        begun.append(number)
        sleep(0.001 * (number % 3))
        return number

    for count, found in enumerate(parallel.in_order((partial(work, k) for k in range(20)), most=most)):
        assert found == count
        assert len(begun) <= count + max(1, cores if most is None else min(most, cores))
    assert sorted(begun) == list(range(20))


def test_all_threads_do_works_that_come_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(parallel, "_pool", parallel._Pool())
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 4)
    all_here, here = Barrier(4), list[int]()

    def work(number: int) -> None:
        if number < 4:
            all_here.wait(10)
        sleep(0.01)
        if current_thread() is main_thread():
            here.append(number)

    assert len(list(parallel.in_order(partial(work, number) for number in range(24)))) == 24
    assert len(here) <= 16


def test_an_error_comes_in_its_place_and_ends_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.kernels.parallel.cores", lambda: 3)
    begun, seen = list[int](), list[int]()

    def work(number: int) -> int:
        begun.append(number)
        if number == 4:
            raise ValueError("in 4")
        return number

    with pytest.raises(ValueError, match="in 4"):
        seen.extend(parallel.in_order(partial(work, k) for k in range(100)))
    assert seen == [0, 1, 2, 3]
    assert len(begun) <= 4 + 3
