"""Run work in chunks on every core. NumPy releases the GIL while it copies and adds."""

from __future__ import annotations

import os
from collections.abc import Callable, Generator, Iterable
from functools import wraps
from threading import Semaphore, Thread
from typing import Concatenate, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Item = TypeVar("Item")


def cores() -> int:
    """Return the number of threads. NUMBA_NUM_THREADS limits it, as it limits numba's own parallel loops."""
    bound = os.environ.get("NUMBA_NUM_THREADS", "")
    if bound.isdecimal():
        return max(1, int(bound))
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def on_every_core(kernel: Callable[Concatenate[int, int, Arguments], None]) -> Callable[Arguments, None]:
    """Make a compiled kernel(core, cores, ...) a function that runs it on every core at once.

    core is 0 .. cores - 1. Where tasks are large or take different times, a kernel does the tasks range(core, count,
    cores). Where they are small, it does those of part_of(): neighbours in memory.

    Numba's own parallel loops are not used: their kernels take 1.4 to 4 times as long to compile.
    """

    @wraps(kernel)
    def run(*arguments: Arguments.args, **named: Arguments.kwargs) -> None:
        threads = cores()
        over_chunks(lambda core, _: kernel(core, threads, *arguments, **named), threads, 1)

    return run


def over_chunks(work: Callable[[int, int], None], count: int, chunk: int) -> None:
    """Call work(begin, end) for every chunk of 0 .. count, distributed over the cores.

    Each chunk must write to a separate part of the output; the result then does not depend on the number of cores. The
    first error stops the other threads and is raised here.
    """
    starts = range(0, count, chunk)
    threads = max(1, min(len(starts), cores()))
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
    run(starts[::threads])
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
