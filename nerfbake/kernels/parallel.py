"""Run work in chunks on every core. NumPy releases the GIL while it copies and adds.

One pool of threads does the work of all loops. The caller of a loop works, too, and never waits for a chunk that no
thread has begun. So loops may be nested, and end if all threads of the pool are busy or no thread can be started.

Other threads work in the context of the caller, with its memory limit. They report no progress.
"""

from __future__ import annotations

import atexit
import os
from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import suppress
from contextvars import Context, copy_context
from functools import wraps
from queue import SimpleQueue
from threading import Condition, Semaphore, Thread, current_thread
from typing import Concatenate, ParamSpec, TypeVar

import numpy as np

from nerfbake import progress
from nerfbake.kernels.arrays import Ints

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

    core is 0 .. cores - 1. A kernel does the tasks range(core, count, cores), or, where they are small, those of
    part_of(): neighbours in memory. Where they are large or take different times, use taken_in_turn().

    Numba's own parallel loops are not used: their kernels take 1.4 to 4 times as long to compile.
    """

    @wraps(kernel)
    def run(*arguments: Arguments.args, **named: Arguments.kwargs) -> None:
        threads = cores()
        over_chunks(lambda core, _: kernel(core, threads, *arguments, **named), threads, 1)

    return run


def _nothing(task: int) -> None:
    """The work of a task that is finished."""


class _Shared:
    """Tasks that threads take in turn. The first error ends them; `errors` has it first."""

    def __init__(self, work: Callable[[int], None], tasks: Iterable[int]) -> None:
        self.errors: list[BaseException] = []
        self._work, self._tasks = work, iter(tasks)
        self._helpers, self._finished = set[Thread](), False
        self._changed = Condition()
        self._context = copy_context()

    def help(self) -> None:
        """Do tasks in a thread of the pool, unless the caller has finished."""
        with self._changed:
            if self._finished:
                return
            self._helpers.add(current_thread())
        self._context.copy().run(self._run_silently)  # two threads cannot run in one context
        with self._changed:
            self._helpers.discard(current_thread())
            self._changed.notify_all()

    def _run_silently(self) -> None:
        progress.end_reports()
        self.run()

    def run(self) -> None:
        """Do tasks until none is left."""
        try:
            while not self.errors:
                with self._changed:
                    task = next(self._tasks, None)
                if task is None:
                    return
                self._work(task)
        except BaseException as error:
            self.errors.append(error)

    def finish(self) -> None:
        """Begin no further tasks, and wait for those that other threads have begun. Ctrl-C does not end the wait.

        Python's join() would return at once after a Ctrl-C. A helper may itself free what uses these tasks.
        """
        while True:
            try:
                with self._changed:
                    self._tasks, self._finished = iter(()), True
                    while self._helpers - {current_thread()}:
                        self._changed.wait()
                break
            except BaseException as error:
                self.errors.append(error)
        self._work, self._context = _nothing, Context()  # the pool may still hold invitations

    def raise_first(self) -> None:
        if self.errors:
            raise self.errors[0]


class _Pool:
    """Threads that wait for work until the process ends: as many as a loop has asked for at once.

    It has no lock. The garbage collector may end a loop at any line, which waits for threads that would need the lock.
    """

    def __init__(self) -> None:
        self._invitations: SimpleQueue[_Shared | None] = SimpleQueue()
        self._threads: list[Thread] = []

    def invite(self, shared: _Shared, helpers: int) -> None:
        """Ask so many threads to help, or fewer if the operating system allows no more. Busy ones come later."""
        self.start(helpers)
        for _ in range(min(helpers, len(self._threads))):
            self._invitations.put(shared)

    def start(self, threads: int) -> None:
        """Have so many threads, or fewer if the operating system allows no more."""
        with suppress(RuntimeError):
            while len(self._threads) < threads:
                thread = Thread(target=self._serve, name="nerfbake", daemon=True)
                thread.start()
                self._threads.append(thread)

    def _serve(self) -> None:
        while (shared := self._invitations.get()) is not None:
            shared.help()
            del shared  # frees the frames of its errors while the thread waits

    def close(self) -> None:
        """End the threads. Python would end while they still run compiled code."""
        for _ in self._threads:
            self._invitations.put(None)
        for thread in self._threads:
            thread.join()


_pool = _Pool()


def _renew() -> None:
    """Start anew in the child of a fork, which has none of the threads."""
    global _pool
    _pool = _Pool()


atexit.register(lambda: _pool.close())
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)


def taken_in_turn(kernel: Callable[Concatenate[Ints, Arguments], None]) -> Callable[Arguments, None]:
    """Make a compiled kernel(turn, ...) a function that runs it on every core at once.

    The kernel does the tasks whose numbers next_task(turn) returns, until that is the number of tasks.
    """

    @wraps(kernel)
    def run(*arguments: Arguments.args, **named: Arguments.kwargs) -> None:
        turn = np.zeros(1, np.int64)
        over_chunks(lambda *_: kernel(turn, *arguments, **named), cores(), 1)

    return run


def over_chunks(work: Callable[[int, int], None], count: int, chunk: int) -> None:
    """Call work(begin, end) for every chunk of 0 .. count; the cores take the chunks in turn.

    Each chunk must write to a separate part of the output; the result then does not depend on the number of cores. The
    first error stops the other threads and is raised here.
    """
    starts = range(0, count, chunk)
    shared = _Shared(lambda start: work(start, min(start + chunk, count)), starts)
    try:
        _pool.invite(shared, min(len(starts), cores()) - 1)
        shared.run()
    finally:
        shared.finish()
    shared.raise_first()


def prefetched(items: Iterable[Item]) -> Generator[Item]:
    """Yield the same items. Each item is computed while the caller uses the previous one, if there are two cores."""
    source, made = iter(items), list[Item]()
    made.extend(_some(source))
    while made:
        item = made.pop()
        ahead = _Shared(lambda _: made.extend(_some(source)), range(1))
        try:
            _pool.invite(ahead, min(cores() - 1, 1))
            yield item
            ahead.run()
        finally:
            ahead.finish()
        ahead.raise_first()


def in_order(works: Iterable[Callable[[], Item]], *, most: int | None = None) -> Generator[Item]:
    """Yield what the works return, in order. Other threads do them while the next works are made.

    most: number of results that exist at once; None: one for each core.
    """
    most = cores() if most is None else max(1, min(most, cores()))
    waiting: deque[tuple[_Shared, list[Item]]] = deque()

    def results(count: int) -> Generator[Item]:
        while len(waiting) > count:
            first, made = waiting[0]
            for shared, _ in waiting:
                if made or first.errors:  # what is not begun is left to the other threads
                    break
                shared.run()
            first.finish()
            first.raise_first()
            waiting.popleft()
            yield made.pop()

    _pool.start(most - 1)
    try:
        for work in works:
            waiting.append(_begun(work, most - 1))
            yield from results(most - 1)
        yield from results(0)
    finally:
        for shared, _ in waiting:
            shared.finish()


def _begun(work: Callable[[], Item], helpers: int) -> tuple[_Shared, list[Item]]:
    """Let a thread of the pool do the work if there is one. Returns it, and the list that gets its result."""
    made = list[Item]()
    shared = _Shared(lambda _: made.append(work()), range(1))
    _pool.invite(shared, min(helpers, 1))
    return shared, made


def _some(source: Iterator[Item]) -> list[Item]:
    """Return the next item in a list, or an empty list at the end."""
    for item in source:
        return [item]
    return []


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
