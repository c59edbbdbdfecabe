"""Work in chunks on every core: NumPy lets go of the interpreter while it copies and adds."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from threading import Semaphore, Thread
from typing import TypeVar

Item = TypeVar("Item")


def cores() -> int:
    """How many threads share the work: as many as numba's own loops have, so that a batch bounds both."""
    bound = os.environ.get("NUMBA_NUM_THREADS", "")
    return max(1, int(bound) if bound.isdecimal() else os.cpu_count() or 1)


def on_every_core(work: Callable[[int, int], None]) -> None:
    """work(first, step) on every core at once: each does every step-th of some tasks, from `first` on.

    Threads take a kernel that is compiled without parallel loops: of one with many arrays in tuples, numba takes 14 s
    to compile such a loop, which does nothing but call another kernel.
    """
    threads = cores()
    over_chunks(lambda first, _: work(first, threads), threads, 1)


def over_chunks(work: Callable[[int, int], None], count: int, chunk: int) -> None:
    """work(begin, end) for every chunk of 0 .. count, shared out among the cores.

    Each chunk must write to places of its own; then what comes out does not depend on the number of cores. The
    first error ends the other threads' work and is raised here.
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


def ahead(items: Iterable[Item]) -> Generator[Item]:
    """The same items, each made while the one before it is used."""
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


def in_relay(work: Callable[[int, int, int], None], runners: int, count: int, chunk: int) -> None:
    """work(runner, begin, end) for every chunk of 0 .. count in order, a thread for each runner: a chunk is a runner's
    when the one before it has done with it. The first error ends all of them and is raised here.
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
            done[runner].release(-(-count // chunk) + 1)  # nobody waits for a runner who has stopped

    others = [Thread(target=run, args=(runner,)) for runner in range(1, runners)]
    for thread in others:
        thread.start()
    run(0)
    for thread in others:
        thread.join()
    if errors:
        raise errors[0]
