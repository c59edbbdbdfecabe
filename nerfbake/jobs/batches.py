"""Many command lines as one batch, which can be stopped and gone on with at any time."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import nerfbake
from nerfbake import progress
from nerfbake.batch.child import Children, nerfbake_command
from nerfbake.batch.crew import Crew, Plan, Told
from nerfbake.batch.files import require_report, save_plan, write_report
from nerfbake.batch.items import Item as Item
from nerfbake.batch.items import require_apart
from nerfbake.batch.report import Batch as Batch
from nerfbake.batch.report import Row
from nerfbake.batch.room import Room
from nerfbake.batch.state import DONE, Attempt, State
from nerfbake.errors import UsageError
from nerfbake.io.locks import occupied
from nerfbake.io.machine import cores, machine
from nerfbake.jobs.steps import SILENT, Steps

_SHOWN = 4  # names of items that run, in a terminal's line
Report = Callable[[dict[str, Any]], None]


class Run(NamedTuple):
    """How the items of a batch are run.

    jobs       how many beside each other; None: half as many as there are cores
    shard      (i, n): every n-th item from i, from 0; all shards together are the batch
    retries    how often an item is tried again that was killed, or whose output could not be written
    fail_fast  no more items start once one is not done
    memory     bytes that all running items may take together, as far as that can be told before; one always runs
    verify     whether an item is done is told from the contents of its files, not from their sizes and times
    take_over  of a batch on the same state and shard that left its lock behind
    """

    jobs: int | None = None
    shard: tuple[int, int] = (0, 1)
    retries: int = 0
    fail_fast: bool = False
    memory: int | None = None
    verify: bool = False
    take_over: bool = False

    def require(self) -> None:
        """Raises UsageError for what contradicts itself."""
        number, count = self.shard
        if not 0 <= number < count:
            raise UsageError(f"the shard {number}/{count} is none; allowed: 0/{count} to {count - 1}/{count}")
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"{self.jobs} jobs do nothing; allowed: 1 or more")


ALL = Run()


def run_batch(
    items: Sequence[Item],
    *,
    state: str | Path,
    run: Run | None = ALL,
    report_to: str | Path | None = None,
    steps: Steps = SILENT,
    report: Report | None = None,
) -> Batch:
    """Runs command lines of nerfbake, each in a process of its own, and gives what came of them; `nerfbake batch`.

    An item is done if the folder `state` has recorded it, with the same line, contents of inputs and version of
    nerfbake, and its outputs are there: it is not run again. Items that fail do not keep the others from running.
    Outputs are replaced only where the state has recorded them.

    run        None: nothing is run, and what the state has recorded of the items is given
    report_to  a page (.html), or a table (.md, .csv), of what is given
    report     gets each attempt when it is over, as it is recorded

    Raises UsageError, before anything runs, where two items would get in each other's way; OutputError where the state
    or the report cannot be written. What becomes of the items is in what is returned.

    >>> item = Item(("svo", "a.npz", "batch.svo.pb"), reads=("a.npz",), writes=("batch.svo.pb",))
    >>> batch = run_batch([item], state="run")
    >>> batch.counts, batch.exit_code
    ({'done': 1}, 0)
    >>> run_batch([item], state="run").ran
    0
    """
    keep = [str(state), *([str(report_to)] if report_to else [])]
    require_apart(items, keep)
    require_report(state, report_to)
    if run is None:
        known = State(state)
        batch = Batch(tuple(_recorded(known, items)), machines=tuple(sorted(known.machines)))
        for row in batch.rows:
            if report is not None:
                report({"event": "item", "argv": row.item.argv, "status": row.status})
    else:
        run.require()
        save_plan(state, items)
        number, count = run.shard
        shard = f"{number}-of-{count}"
        with occupied(Path(state) / f"lock.{shard}", take_over=run.take_over):
            batch = _run(State(state), items[number::count], run, shard, steps, report)
    if report_to:
        write_report(batch, report_to, state=state)
    return batch


def _recorded(state: State, items: Iterable[Item], *, read: bool = True) -> Iterator[Row]:
    """What came of items as they are now; nothing of one that was done, if that is not there any more. read: inputs
    are read where their sizes or times have changed; else such an item counts as another.
    """
    for item in items:
        identity = state.identify(item, read=read)
        last = state.last(identity)
        yield Row(item, state.done(identity) or (last if last is None or last.status != DONE else None))


def _run(state: State, items: Sequence[Item], run: Run, shard: str, steps: Steps, report: Report | None) -> Batch:
    jobs = run.jobs or max(1, cores() // 2)
    facts = {"machine": machine(), "python": platform.python_version(), "nerfbake": nerfbake.__version__}
    children = Children(nerfbake_command(), max(1, cores() // jobs))
    crew = Crew(state, children, Room(run.memory), Plan(jobs, run.retries, run.fail_fast, run.verify))
    found: dict[int, Attempt] = {}
    tried: set[int] = set()
    running: dict[int, str] = {}

    with state.opened(shard, facts, time.time()), steps.phase(f"{len(items):,} items"):

        def tell(told: Told) -> None:
            if told.attempt is None:
                tried.add(told.number)
                running[told.number] = items[told.number].name
            else:
                running.pop(told.number, None)
                found[told.number] = told.attempt
                _say(steps, items[told.number], told.attempt)
                if report is not None:
                    report(told.event or {"event": "skip", "argv": items[told.number].argv})
            bad = sum(attempt.status != DONE for attempt in found.values())
            shown = ", ".join(islice(running.values(), _SHOWN))
            progress.report(len(found) / len(items), f"{len(found) - bad} done, {bad} not: {shown}")

        crew.run(items, range(len(items)), tell)
    missed = _recorded(state, (item for number, item in enumerate(items) if number not in found), read=False)
    rows = tuple(Row(item, found[number]) if number in found else next(missed) for number, item in enumerate(items))
    return Batch(rows, len(tried), crew.signal, tuple(sorted(state.machines)))


def _say(steps: Steps, item: Item, attempt: Attempt) -> None:
    if attempt.status != DONE:
        steps.say(f"{attempt.status} (exit {attempt.code}): {attempt.error}")
        steps.say(item.pasteable)
