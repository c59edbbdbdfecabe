"""Threads that take items one after the other, each of which waits for a process of its own."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple

from nerfbake.batch.child import Children, Ended
from nerfbake.batch.items import Item
from nerfbake.batch.room import Room
from nerfbake.batch.state import DONE, FAILED, KILLED, REJECTED, Attempt, Identity, State, outputs_of
from nerfbake.errors import BudgetMissed, OutputError
from nerfbake.io.journal import Event

PATIENCE = 10.0  # seconds between SIGTERM and SIGKILL
_POLL = 0.2  # seconds: a signal that arrives just before a wait begins does not end that wait
_AGAIN = {OutputError.exit_code}  # beside what was killed: a full disk may have room again


class Told(NamedTuple):
    """What happened to an item: it began, it was there already, or it was tried. event: as it is recorded."""

    number: int
    attempt: Attempt | None
    event: Event | None = None


class Plan(NamedTuple):
    """How items are run.

    jobs       how many beside each other
    retries    how often one is tried again that was killed, or whose output could not be written
    fail_fast  no more begin once one is not done
    verify     inputs and outputs are read, whatever their sizes and times say
    """

    jobs: int
    retries: int = 0
    fail_fast: bool = False
    verify: bool = False


class Crew:
    """Runs items; whatever happens to them is told to whoever called run(), in the thread that did."""

    def __init__(self, state: State, children: Children, room: Room, plan: Plan) -> None:
        self._state, self._children, self._room, self._plan = state, children, room, plan
        self._events: SimpleQueue[Told | BaseException | int | None] = SimpleQueue()
        self._next, self._over, self.signal = threading.Lock(), False, 0

    def run(self, items: Sequence[Item], numbers: Sequence[int], tell: Callable[[Told], None]) -> None:
        """Runs these of the items. Afterwards `signal` is the number of the one that has stopped it, 0 if none has.

        Raises what went wrong with the state.
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
                elif isinstance(event, Told):
                    tell(event)
                else:
                    if isinstance(event, int):
                        self.signal = self.signal or event
                    fault = fault or (event if isinstance(event, BaseException) else None)
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
        """Ctrl-C and SIGTERM become events, where signals can be had: in the main thread."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
        heard = [number for number, handler in before.items() if handler not in (signal.SIG_IGN, None)]
        for number in heard:
            signal.signal(number, lambda number, frame: self._events.put(int(number)))
        try:
            yield
        finally:
            for number in heard:
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
            self._events.put(Told(number, done))
            return
        last = self._state.last(identity)
        with self._room.taken(self._room.estimate(item, last.peak if last else 0)):
            for again in range(self._plan.retries + 1):
                if self._over or not self._try(item, identity, number, again + 1):
                    break

    def _try(self, item: Item, identity: Identity, number: int, attempt: int) -> bool:
        """Tries an item once. True if it is worth another try."""
        at = time.time()
        claims = self._state.begin(item, identity, at)
        argv = item.forced() if self._state.may_replace(item) else item.argv
        self._events.put(Told(number, None))
        for path in item.writes:
            _make_parents(path)
        ended = self._children.run(argv, self._state.folder / "log" / identity.id)
        if ended is None:  # between its start and that of its process the batch was stopped
            ended = Ended(128 + signal.SIGTERM, True, "the batch was stopped before this began", None, 0.0, 0)
        found = _judged(item, ended)._replace(read=identity.read, number=attempt, at=at)
        event = self._state.end(item, identity, found, claims)
        if found.status != DONE and self._plan.fail_fast:
            self._over = True
        self._events.put(Told(number, found, event))
        return found.status == KILLED or found.code in _AGAIN


def _judged(item: Item, ended: Ended) -> Attempt:
    """What a process has left behind."""
    status, error = FAILED, ended.error
    outputs = outputs_of(item.writes if ended.code == 0 else item.spare if ended.code == BudgetMissed.exit_code else ())
    if ended.killed:
        status, error = KILLED, error or f"was killed (exit {ended.code})"
    elif ended.code == BudgetMissed.exit_code:
        status = REJECTED
    elif ended.code == 0 and len(outputs) == len(item.writes):
        status = DONE
    elif ended.code == 0:
        gone = sorted({*item.writes} - {output.path for output in outputs})
        error = f"{gone[0]}: was not written, though the command says that it is done"
    return Attempt(status, ended.code, error, ended.seconds, ended.peak, outputs=outputs, psnr=ended.psnr)


def _make_parents(path: str) -> None:
    """The folder that an output goes to; where there can be none, the command itself says why."""
    try:
        Path(path).parent.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
