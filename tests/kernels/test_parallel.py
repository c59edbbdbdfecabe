from __future__ import annotations

import os
from collections.abc import Iterator

import numpy as np
import pytest

from nerfbake.kernels import parallel
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.jit import compiled, part_of


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


def test_an_error_in_any_thread_is_raised() -> None:
    def work(begin: int, end: int) -> None:
        if begin == 30:
            raise ValueError(f"{begin} to {end}")

    with pytest.raises(ValueError, match="30 to 40"):
        parallel.over_chunks(work, 100, 10)


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
    assert made == [0, 1, 2]
