"""Run work in chunks on every core. NumPy releases the GIL while it copies and adds."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from threading import Semaphore, Thread
from typing import TypeVar

Item = TypeVar("Item")


def cores() -> int:
    """Return the number of threads: the same as for numba's parallel loops, so NUMBA_NUM_THREADS limits both."""
    bound = os.environ.get("NUMBA_NUM_THREADS", "")
    return max(1, int(bound) if bound.isdecimal() else os.cpu_count() or 1)


def on_every_core(work: Callable[[int, int], None]) -> None:
    """Call work(first, step) on every core at once. Each call does every step-th task, starting at `first`.

    Use this for compiled kernels without parallel loops: for a kernel with many arrays in tuples, numba takes 14 s to
    compile a parallel loop that does nothing but call another kernel.
    """
    threads = cores()
    over_chunks(lambda first, _: work(first, threads), threads, 1)


def over_chunks(work: Callable[[int, int], None], count: int, chunk: int) -> None:
    """Call work(begin, end) for every chunk of 0 .. count, distributed over the cores.

    Each chunk must write to a separate part of the output; the result then does not depend on the number of cores. The
    first error stops the other threads and is raised here.
    """
    starts = range(0, count, chunk)
    threads = min(len(starts), cores())
    errors: list[BaseException] = []

    def run(own: range) -> None:
        try:
            for start in own:
                if not errors:
                    work(start, min(start + chunk, count))
        except BaseException as error:
            errors.append(error)

    others = [Thread(target=run, args=(starts[k::threads],)) for k in range(1, threads)]
    for thread in others:
        thread.start()
    run(starts[::threads] if threads else starts)
    for thread in others:
        thread.join()
    if errors:
        raise errors[0]


def prefetched(items: Iterable[Item]) -> Generator[Item]:
    """Yield the same items. Each item is computed while the caller uses the previous one."""
    source, made = iter(items), list[Item]()
    errors: list[BaseException] = []

    def make() -> None:
        try:
            made.append(next(source))
        except BaseException as error:
            errors.append(error)

    make()
    while made:
        item = made.pop()
        maker = Thread(target=make)
        maker.start()
        try:
            yield item
        finally:
            maker.join()
    if not isinstance(errors[0], StopIteration):
        raise errors[0]


def run_in_turn(work: Callable[[int, int, int], None], runners: int, count: int, chunk: int) -> None:
    """Call work(runner, begin, end) for every chunk of 0 .. count in order, with one thread for each runner.

    A runner gets a chunk when the previous runner has finished it. The first error stops all runners and is raised
    here.
    """
    done = [Semaphore(0) for _ in range(runners)]
    errors: list[BaseException] = []

    def run(runner: int) -> None:
        try:
            for begin in range(0, count, chunk):
                if runner:
                    done[runner - 1].acquire()
                if errors:
                    return
                work(runner, begin, min(begin + chunk, count))
                done[runner].release()
        except BaseException as error:
            errors.append(error)
        finally:
            done[runner].release(-(-count // chunk) + 1)  # a stopped runner blocks no other

    others = [Thread(target=run, args=(runner,)) for runner in range(1, runners)]
    for thread in others:
        thread.start()
    run(0)
    for thread in others:
        thread.join()
    if errors:
        raise errors[0]
