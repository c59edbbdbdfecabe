"""Run many command lines as one batch, which can be interrupted and resumed at any time."""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

from nerfbake import __version__, progress
from nerfbake.batch.child import ChildProcesses, nerfbake_command, require_processes
from nerfbake.batch.crew import ItemEvent, MemoryQueue, RunPlan, WorkerPool
from nerfbake.batch.items import Item as Item
from nerfbake.batch.items import require_apart
from nerfbake.batch.report import Batch as Batch
from nerfbake.batch.report import Row, require_report, save_plan, write_report
from nerfbake.batch.state import DONE, Attempt, State
from nerfbake.errors import UsageError
from nerfbake.io.locks import occupied
from nerfbake.io.machine import cores, machine
from nerfbake.jobs.steps import SILENT, Steps

_SHOWN = 4  # maximum names of running items in the progress line
Report = Callable[[dict[str, Any]], None]


@dataclass(frozen=True, kw_only=True)
class BatchOptions:
    """How the items of a batch are run.

    jobs       number of items that run in parallel; None: half the cores
    shard      (i, n): run every n-th item, starting with item i, counted from 0; all shards together are the batch
    retries    number of retries of an item that was killed or could not write its output
    fail_fast  start no more items after one that is not done
    memory     limit for the estimated memory of all running items in bytes; one item always runs; None: no limit
    verify     compare inputs and outputs by their contents, not by size and time
    take_over  replace the lock that another batch on the same state and shard has left behind
    """

    jobs: int | None = None
    shard: tuple[int, int] = (0, 1)
    retries: int = 0
    fail_fast: bool = False
    memory: int | None = None
    verify: bool = False
    take_over: bool = False

    def require(self) -> None:
        """Raise UsageError for values that are not allowed."""
        number, count = self.shard
        if not 0 <= number < count:
            allowed = f"0/{count} to {count - 1}/{count}" if count > 0 else "I/N, with N of 1 or more"
            raise UsageError(f"`shard` is {number}/{count}; allowed: {allowed}")
        if self.jobs is not None and self.jobs < 1:
            raise UsageError(f"`jobs` is {self.jobs}; allowed: 1 or more")


def run_batch(
    items: Sequence[Item],
    *,
    state: str | Path,
    run: BatchOptions | None = BatchOptions(),
    report_to: str | Path | None = None,
    steps: Steps = SILENT,
    report: Report | None = None,
) -> Batch:
    """Run command lines of nerfbake, each in its own process, and return the results. This is `nerfbake batch`.

    An item is done if the folder `state` has recorded it with the same arguments, contents of inputs and version of
    nerfbake, and if its outputs exist. It is then not run again. If an item fails, the others still run. Existing
    outputs are replaced only if the state has recorded them.

    run        how to run the items; None: run nothing, and return the recorded results
    report_to  write the results to this page (.html) or table (.md, .csv)
    report     is called with the record of each attempt when it ends

    Raises UsageError before anything runs if items conflict, and OutputError if the state or the report cannot be
    written. The errors of items are in the results.

    >>> item = Item(("svo", "a.npz", "batch.svo.pb"), reads=("a.npz",), writes=("batch.svo.pb",))
    >>> batch = run_batch([item], state="run")
    >>> batch.counts, batch.exit_code
    ({'done': 1}, 0)
    >>> run_batch([item], state="run").ran
    0
    """
    if run is not None:
        require_processes()
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
    """Return a row for each item as it is now. An item whose outputs no longer exist has no attempt.

    read: hash the inputs whose size or time has changed; False: treat an item with such inputs as not tried.
    """
    for item in items:
        identity = state.identify(item, read=read)
        last = state.last(identity)
        yield Row(item, state.done(identity) or (last if last is None or last.status != DONE else None))


def _run(
    state: State, items: Sequence[Item], run: BatchOptions, shard: str, steps: Steps, report: Report | None
) -> Batch:
    jobs = run.jobs or max(1, cores() // 2)
    facts = {"machine": machine(), "python": platform.python_version(), "nerfbake": __version__}
    children = ChildProcesses(nerfbake_command(), max(1, cores() // jobs))
    pool = WorkerPool(state, children, MemoryQueue(run.memory), RunPlan(jobs, run.retries, run.fail_fast, run.verify))
    found: dict[int, Attempt] = {}
    tried: set[int] = set()
    running: dict[int, str] = {}

    with state.opened(shard, facts, time.time()), steps.phase(f"{len(items):,} items"):

        def handle(change: ItemEvent) -> None:
            if change.attempt is None:
                tried.add(change.number)
                running[change.number] = items[change.number].name
            else:
                running.pop(change.number, None)
                found[change.number] = change.attempt
                _print_failure(steps, items[change.number], change.attempt)
                if report is not None:
                    report(change.event or {"event": "skip", "argv": items[change.number].argv})
            bad = sum(attempt.status != DONE for attempt in found.values())
            shown = ", ".join(islice(running.values(), _SHOWN))
            progress.report(len(found) / len(items), f"{len(found) - bad} done, {bad} not done, running: {shown}")

        pool.run(items, range(len(items)), handle)
    others = _recorded(state, (item for number, item in enumerate(items) if number not in found), read=False)
    rows = tuple(Row(item, found[number]) if number in found else next(others) for number, item in enumerate(items))
    return Batch(rows, len(tried), pool.signal, tuple(sorted(state.machines)))


def _print_failure(steps: Steps, item: Item, attempt: Attempt) -> None:
    if attempt.status != DONE:
        steps.say(f"{attempt.status} (exit {attempt.code}): {attempt.error}")
        steps.say(item.line)
