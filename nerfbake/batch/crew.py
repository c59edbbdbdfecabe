"""Run items in parallel: a pool of threads, each of which starts a process for one item after another.

With a memory limit, an item starts only when its estimated memory is free. One item always runs, even if it needs more
than the limit.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple

from nerfbake.batch.child import ChildProcesses, ProcessResult
from nerfbake.batch.items import Item
from nerfbake.batch.state import DONE, FAILED, KILLED, REJECTED, Attempt, ItemIdentity, State, outputs_of
from nerfbake.errors import BudgetMissed, OutputError
from nerfbake.io.digests import decoded_bytes
from nerfbake.io.journal import Event

_PER_BYTE = 4  # bytes of memory per byte of decoded input: its arrays, the results, and pictures that compare them
_PROGRAM = 160 << 20  # bytes of memory of an interpreter with all libraries


class MemoryQueue:
    """The memory of all running items. limit: their maximum total in bytes; None: no limit."""

    def __init__(self, limit: int | None) -> None:
        self._limit, self._taken, self._running = limit, 0, 0
        self._turn, self._changed, self._closed = threading.Lock(), threading.Condition(), False

    @contextmanager
    def taken(self, need: int) -> Iterator[None]:
        """Wait until `need` bytes are free or no other item runs, and reserve them for the duration of the block.

        Callers are served in order. Otherwise small items could keep a large one waiting forever.
        """
        with self._turn, self._changed:
            self._changed.wait_for(lambda: self._fits(need))
            self._taken, self._running = self._taken + need, self._running + 1
        try:
            yield
        finally:
            with self._changed:
                self._taken, self._running = self._taken - need, self._running - 1
                self._changed.notify_all()

    def _fits(self, need: int) -> bool:
        return self._limit is None or self._closed or not self._running or self._taken + need <= self._limit

    def close(self) -> None:
        """Stop waiting for memory: every waiting and later caller of taken() continues at once."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def estimate(self, item: Item, peak: int) -> int:
        """Estimate the memory of an item in bytes: the peak of its last attempt, else from the size of its inputs.

        peak: peak memory of the last attempt; 0 if there was none.
        """
        if self._limit is None:
            return 0
        return peak or _PROGRAM + _PER_BYTE * sum(map(decoded_bytes, (*item.reads, *item.albums)))


PATIENCE = 10.0  # seconds between SIGTERM and SIGKILL
_POLL = 0.2  # seconds; a signal that arrives just before a wait begins does not end the wait


class ItemEvent(NamedTuple):
    """A change of an item's status.

    number   index of the item
    attempt  None: the item has started; else its finished attempt, or the earlier one that makes it done
    event    the record of the attempt in the state; None if this run made no attempt
    """

    number: int
    attempt: Attempt | None
    event: Event | None = None


class RunPlan(NamedTuple):
    """How items are run.

    jobs       number of items that run in parallel
    retries    number of retries of an item that was killed or could not write its output
    fail_fast  start no more items after one that is not done
    verify     compare inputs and outputs by their contents, not by size and time
    """

    jobs: int
    retries: int = 0
    fail_fast: bool = False
    verify: bool = False


class WorkerPool:
    """Runs items in threads, and reports their events in the thread that called run()."""

    def __init__(self, state: State, children: ChildProcesses, room: MemoryQueue, plan: RunPlan) -> None:
        self._state, self._children, self._room, self._plan = state, children, room, plan
        self._events: SimpleQueue[ItemEvent | BaseException | int | None] = SimpleQueue()
        self._next, self._over, self.signal = threading.Lock(), False, 0

    def run(self, items: Sequence[Item], numbers: Sequence[int], tell: Callable[[ItemEvent], None]) -> None:
        """Run the items with these numbers, and call tell() for each event.

        Afterwards `signal` is the number of the signal that stopped the run; 0 if none did. Raises the first exception
        of a thread, for example OutputError if the state cannot be written.
        """
        waiting = iter(numbers)
        work = [threading.Thread(target=self._work, args=(items, waiting)) for _ in range(self._plan.jobs)]
        with self._signals():
            for thread in work:
                thread.start()
            left, deadline, fault = len(work), 0.0, None
            while left:
                try:
                    event = self._events.get(timeout=_POLL)
                except Empty:
                    if deadline and time.monotonic() >= deadline:
                        self._children.stop(signal.SIGKILL)
                        deadline = 0.0
                    continue
                if event is None:
                    left -= 1
                elif isinstance(event, ItemEvent):
                    tell(event)
                else:
                    if isinstance(event, int):
                        self.signal = self.signal or event
                    else:
                        fault = fault or event
                    deadline = deadline or time.monotonic() + PATIENCE
                    self._stop()
            for thread in work:
                thread.join()
        if fault is not None:
            raise fault

    def _stop(self) -> None:
        self._over = True
        self._children.stop()
        self._room.close()

    @contextmanager
    def _signals(self) -> Iterator[None]:
        """Turn SIGINT and SIGTERM into events. Only the main thread can handle signals."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        handled = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
        for number in handled:
            signal.signal(number, lambda number, frame: self._events.put(int(number)))
        try:
            yield
        finally:
            for number in handled:
                signal.signal(number, before[number])

    # -- in each thread --------------------------------------------------------------------------------------------
    def _work(self, items: Sequence[Item], waiting: Iterator[int]) -> None:
        try:
            while not self._over:
                with self._next:
                    number = next(waiting, None)
                if number is None:
                    break
                self._do(items[number], number)
        except BaseException as error:
            self._events.put(error)
        finally:
            self._events.put(None)

    def _do(self, item: Item, number: int) -> None:
        identity = self._state.identify(item, verify=self._plan.verify)
        if (done := self._state.done(identity, verify=self._plan.verify)) is not None:
            self._events.put(ItemEvent(number, done))
            return
        last = self._state.last(identity)
        with self._room.taken(self._room.estimate(item, last.peak if last else 0)):
            for retry in range(self._plan.retries + 1):
                if self._over or not self._try(item, identity, number, retry + 1):
                    break

    def _try(self, item: Item, identity: ItemIdentity, number: int, attempt: int) -> bool:
        """Run an item once. True if a retry may succeed."""
        at = time.time()
        claims = self._state.begin(item, identity, at)
        argv = item.forced() if self._state.may_replace(item) else item.argv
        self._events.put(ItemEvent(number, None))
        for path in item.writes:
            with suppress(OSError):  # the command itself reports that the folder cannot be created
                Path(path).parent.mkdir(parents=True, exist_ok=True)
        result = self._children.run(argv, self._state.folder / "log" / identity.id)
        if result is None:  # the batch was stopped after the start was recorded
            result = ProcessResult(
                128 + signal.SIGTERM, True, "the batch was stopped before this item started", None, 0.0, 0
            )
        found = _attempt_of(item, result)._replace(read=identity.read, number=attempt, at=at)
        event = self._state.end(item, identity, found, claims)
        if found.status != DONE and self._plan.fail_fast:
            self._over = True
        self._events.put(ItemEvent(number, found, event))
        # An OutputError is retried, as killed items are: a full disk may have space again.
        return found.status == KILLED or found.code == OutputError.exit_code


def _attempt_of(item: Item, result: ProcessResult) -> Attempt:
    """The attempt that a process made, with its status and outputs."""
    status, error = FAILED, result.error
    written = item.writes if result.code == 0 else item.spare if result.code == BudgetMissed.exit_code else ()
    outputs = outputs_of(written)
    if result.killed:
        status, error = KILLED, error or f"was killed (exit {result.code})"
    elif result.code == BudgetMissed.exit_code:
        status = REJECTED
    elif result.code == 0 and len(outputs) == len(item.writes):
        status = DONE
    elif result.code == 0:
        missing = sorted({*item.writes} - {output.path for output in outputs})
        error = f"{missing[0]}: was not written, although the command succeeded"
    return Attempt(status, result.code, error, result.seconds, result.peak, outputs=outputs, psnr=result.psnr)
