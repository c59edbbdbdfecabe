"""What came of a batch: an item a row, and what they come to. The same state gives the same report."""

from __future__ import annotations

import signal
from collections import Counter
from collections.abc import Callable, Sequence
from typing import NamedTuple

from nerfbake.batch.items import Item
from nerfbake.batch.state import DONE, FAILED, KILLED, REJECTED, WAITING, Attempt

WORST = 10  # rows of the lists of what stands out
STATUSES = (DONE, FAILED, KILLED, REJECTED, WAITING)
_FAULTS = (FAILED, KILLED, REJECTED, WAITING)  # what stands first


class Row(NamedTuple):
    """An item, and what came of it the last time; None: it has not been tried as it is now."""

    item: Item
    attempt: Attempt | None

    @property
    def status(self) -> str:
        """done, failed, killed, rejected or waiting."""
        return self.attempt.status if self.attempt else WAITING


class Batch(NamedTuple):
    """What came of a batch.

    rows      an item each, in their order
    ran       how many were tried in this run
    stopped   the number of the signal that ended it early; 0: none
    machines  where it ran, and with which versions
    """

    rows: tuple[Row, ...]
    ran: int = 0
    stopped: int = 0
    machines: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """How many items are done, failed, killed, rejected, waiting; without those that no item is."""
        found = Counter(row.status for row in self.rows)
        return {status: found[status] for status in STATUSES if found[status]}

    @property
    def exit_code(self) -> int:
        """0 all are done; 1 some are not; 3 only quality budgets were missed; 130, 143 it was stopped."""
        if self.stopped:
            return 128 + self.stopped
        missing = set(self.counts) - {DONE}
        return 0 if not missing else 3 if missing == {REJECTED} else 1

    @property
    def faults(self) -> list[Row]:
        """Rows that are not done: those that failed first, then killed, rejected and waiting ones."""
        return sorted((row for row in self.rows if row.status != DONE), key=lambda row: _FAULTS.index(row.status))

    @property
    def told(self) -> str:
        """The counts in words."""
        counts = ", ".join(f"{count:,} {status}" for status, count in self.counts.items())
        early = f"; stopped by {signal.Signals(self.stopped).name}" if self.stopped else ""
        return f"{len(self.rows):,} item{'s' * (len(self.rows) != 1)}{': ' * bool(counts)}{counts}{early}"

    @property
    def totals(self) -> Totals:
        tried = [row.attempt for row in self.rows if row.attempt]
        return Totals(
            sum(each.seconds for each in tried),
            sum(each.read for each in tried),
            sum(each.written for each in tried),
            max((each.peak for each in tried), default=0),
        )

    def outstanding(self) -> list[tuple[str, list[Row]]]:
        """Lists of rows that stand out, by what they stand out in, each of those that can be compared."""
        done = [row for row in self.rows if row.status == DONE]
        lists = [(title, _most(done, value)) for title, value in _LISTS]
        return [(title, rows) for title, rows in lists if len(rows) > 1]


class Totals(NamedTuple):
    """Of all items together: seconds of their processes, bytes read and written; peak: of the largest, bytes."""

    seconds: float
    read: int
    written: int
    peak: int


def _most(rows: Sequence[Row], value: Callable[[Attempt], float | None]) -> list[Row]:
    known = [(found, -at) for at, row in enumerate(rows) if row.attempt and (found := value(row.attempt)) is not None]
    return [rows[-at] for _, at in sorted(known, reverse=True)[:WORST]]


_LISTS: tuple[tuple[str, Callable[[Attempt], float | None]], ...] = (
    ("Slowest", lambda attempt: attempt.seconds),
    ("Biggest", lambda attempt: attempt.written or None),
    ("Worst PSNR", lambda attempt: None if attempt.psnr is None else -attempt.psnr),
)
