"""Collect the results of a batch, and write them as a report: Markdown, CSV or a self-contained HTML page.

A report has one row per item. Markdown and HTML list the items that are not done first. The page also shows small
pictures of the outputs. The same state gives the same report. This module also saves and loads the plan of a batch.
"""

from __future__ import annotations

import csv
import html
import os
import signal
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from io import StringIO
from pathlib import Path
from typing import Any, NamedTuple

from nerfbake import io
from nerfbake.batch.items import Item
from nerfbake.batch.state import DONE, FAILED, KILLED, REJECTED, WAITING, Attempt
from nerfbake.errors import NerfbakeError, OutputError, UsageError, format_size, one_line
from nerfbake.formats.wire.page import END, beginning, figure, picture, table, text
from nerfbake.io.journal import Journal, read_journal
from nerfbake.io.own_files import require_no_link

COLUMNS = ("item", "status", "seconds", "peak MB", "MB in", "MB out", "ratio", "PSNR dB")


def row_values(row: Row) -> list[float | None]:
    """The values of a row in COLUMNS after its status; None for an unknown value."""
    attempt = row.attempt
    if attempt is None:
        return [None] * 6
    ratio = attempt.written / attempt.read if attempt.read and attempt.written else None
    return [attempt.seconds, attempt.peak / 1e6, attempt.read / 1e6, attempt.written / 1e6, ratio, attempt.psnr]


def row_texts(values: list[float | None]) -> list[str]:
    """The values of row_values() as text; '' for an unknown value."""
    digits = (".2f", ".0f", ".2f", ".2f", ".1%", ".2f")
    return ["" if value is None else format(value, form) for value, form in zip(values, digits, strict=True)]


def as_csv(batch: Batch) -> str:
    """The batch as CSV, for spreadsheets, with exact values."""
    text = StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["command", "status", "exit", "error", "seconds", "peak_bytes", "bytes_in", "bytes_out", "psnr"])
    for row in batch.rows:
        writer.writerow([row.item.line, row.status, *_exact(row)])
    return text.getvalue()


def _exact(row: Row) -> list[Any]:
    attempt = row.attempt
    if attempt is None:
        return [""] * 7
    psnr = "" if attempt.psnr is None else attempt.psnr
    return [attempt.code, one_line(attempt.error), attempt.seconds, attempt.peak, attempt.read, attempt.written, psnr]


def as_markdown(batch: Batch) -> str:
    """The batch as Markdown. Items that are not done come first."""
    parts = ["# Batch", batch.summary + ".", *(f"- {_cell(machine)}" for machine in batch.machines)]
    if faults := batch.faults:
        parts.append("## Not done")
        parts += [_markdown_fault(row) for row in faults]
    parts += ["## Items", _markdown_table(batch.rows)]
    for title, rows in batch.outstanding():
        parts += [f"## {title}", _markdown_table(rows)]
    return "\n\n".join(parts) + "\n"


def _markdown_fault(row: Row) -> str:
    error = f": {one_line(row.attempt.error)}" if row.attempt and row.attempt.error else ""
    return f"- {row.status}{_cell(error)}\n\n      {row.item.line}"


def _markdown_table(rows: Any) -> str:
    lines = [COLUMNS, ("---", "---", *["---:"] * 6)]
    lines += [(_cell(row.item.name), row.status, *row_texts(row_values(row))) for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "\\|`*_<[&" else letter for letter in text)


_DIGITS = (".2f", ",.0f", ",.2f", ",.2f", ".1%", ".2f")
_WRAPPED = "white-space: pre-wrap; overflow-wrap: anywhere"
_ABOUT = (
    "Seconds and peaks are those of each item's own process. The ratio is of what it wrote to what it read. PSNR is "
    "the value that the command reported. A waiting item has not been tried with its current arguments and inputs."
)


class Thumbnail(NamedTuple):
    """A small picture of an output. name: path of the output; png: the bytes of a PNG file."""

    name: str
    png: bytes


def as_page(batch: Batch, thumbnails: Sequence[Thumbnail] = ()) -> str:
    """The batch as an HTML page. The same batch gives the same bytes."""
    return "".join(_parts(batch, thumbnails))


def _parts(batch: Batch, thumbnails: Sequence[Thumbnail]) -> Iterator[str]:
    yield beginning("Batch")
    kind, words = ("holds", "All done") if not batch.exit_code else ("missed", "Not all done")
    yield f'<h1>Batch <span>of {len(batch.rows):,}</span></h1>\n<p class="verdict {kind}">{words}</p>\n'
    yield _tiles(batch)
    if batch.faults:
        yield f"<h2>Not done</h2>\n{''.join(map(_html_fault, batch.faults))}"
    if thumbnails:
        pictures = "".join(picture(each.png, "", text(each.name)) for each in thumbnails)
        yield f'<h2>Pictures</h2>\n<div class="row">\n{pictures}</div>\n'
    for title, rows in batch.outstanding():
        yield f"<h2>{title}</h2>\n{_html_table(rows)}"
    yield f"<h2>Items</h2>\n{_html_table(batch.rows)}"
    machines = "".join(f"<li>{text(machine)}</li>" for machine in batch.machines)
    yield f'<h2>Where it ran</h2>\n<ul>{machines}</ul>\n<p class="about">{_ABOUT}</p>\n{END}'


def _tiles(batch: Batch) -> str:
    totals = batch.totals
    tiles = {status: figure(count, ",") for status, count in batch.counts.items()}
    tiles |= {"seconds of processes": figure(totals.seconds, ",.1f"), "read": _size(totals.read)}
    tiles |= {"written": _size(totals.written), "largest peak": _size(totals.peak)}
    return f"<dl>{''.join(f'<div><dt>{name}</dt><dd>{value}</dd></div>' for name, value in tiles.items())}</dl>\n"


def _size(count: int) -> str:
    return f'<data value="{count}">{format_size(count)}</data>'


def _html_fault(row: Row) -> str:
    """The error of an item, and its whole command line to paste, of any length."""
    error = f": {text(row.attempt.error)}" if row.attempt and row.attempt.error else ""
    code = f" (exit {row.attempt.code})" if row.attempt else ""
    command = f'<pre style="{_WRAPPED}">{html.escape(row.item.line)}</pre>'
    return f'<section>\n<p class="missed">{row.status}{code}{error}</p>\n{command}\n</section>\n'


def _html_table(rows: Sequence[Row]) -> str:
    return f'<div style="overflow-x: auto">{table(COLUMNS, map(_cells, rows))}</div>\n'


def _cells(row: Row) -> list[str]:
    status = row.status if row.status == DONE else f"<strong>{row.status}</strong>"
    figures = (
        "" if value is None else figure(value, form) for value, form in zip(row_values(row), _DIGITS, strict=True)
    )
    return [text(row.item.name), status, *figures]


WORST = 10  # maximum rows of the lists of slowest, biggest and worst items
STATUSES = (DONE, FAILED, KILLED, REJECTED, WAITING)
_FAULTS = (FAILED, KILLED, REJECTED, WAITING)  # in the order of the report


class Row(NamedTuple):
    """An item and its last attempt. attempt: None if it has not been tried with its current arguments and inputs."""

    item: Item
    attempt: Attempt | None

    @property
    def status(self) -> str:
        """done, failed, killed, rejected or waiting."""
        return self.attempt.status if self.attempt else WAITING


class Batch(NamedTuple):
    """The results of a batch.

    rows      one for each item, in the order of the items
    ran       number of items that were tried in this run
    stopped   number of the signal that stopped the run early; 0 if none did
    machines  the machines that ran items, with their versions of Python and nerfbake
    """

    rows: tuple[Row, ...]
    ran: int = 0
    stopped: int = 0
    machines: tuple[str, ...] = ()

    @property
    def counts(self) -> dict[str, int]:
        """The number of items by status: done, failed, killed, rejected, waiting. A status without items is omitted."""
        found = Counter(row.status for row in self.rows)
        return {status: found[status] for status in STATUSES if found[status]}

    @property
    def exit_code(self) -> int:
        """0: all items are done; 1: some are not; 3: only quality budgets were missed; 130, 143: it was stopped."""
        if self.stopped:
            return 128 + self.stopped
        missing = set(self.counts) - {DONE}
        return 0 if not missing else 3 if missing == {REJECTED} else 1

    @property
    def faults(self) -> list[Row]:
        """The rows of items that are not done: failed, then killed, rejected and waiting ones."""
        return sorted((row for row in self.rows if row.status != DONE), key=lambda row: _FAULTS.index(row.status))

    @property
    def summary(self) -> str:
        """A summary in words: the number of items by status, and the signal that stopped the run."""
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
        """The lists of slowest, biggest and worst items that are done, with their titles.

        A list with fewer than two rows is left out.
        """
        done = [row for row in self.rows if row.status == DONE]
        lists = [(title, _most(done, value)) for title, value in _LISTS]
        return [(title, rows) for title, rows in lists if len(rows) > 1]


class Totals(NamedTuple):
    """Totals of all items: run time in seconds, bytes read and written. peak: the largest memory peak in bytes."""

    seconds: float
    read: int
    written: int
    peak: int


def _most(rows: Sequence[Row], value: Callable[[Attempt], float | None]) -> list[Row]:
    known = [(found, row) for row in rows if row.attempt and (found := value(row.attempt)) is not None]
    return [row for _, row in sorted(known, key=lambda pair: pair[0], reverse=True)[:WORST]]


_LISTS: tuple[tuple[str, Callable[[Attempt], float | None]], ...] = (
    ("Slowest", lambda attempt: attempt.seconds),
    ("Biggest", lambda attempt: attempt.written or None),
    ("Worst PSNR", lambda attempt: None if attempt.psnr is None else -attempt.psnr),
)


THUMBNAILS, EDGE, BYTES = 48, 192, 2_000_000  # limits of a page: pictures, pixels along their edges, total bytes
_NO_PICTURES = (".depth.png", ".alpha.png")  # pictures that the page does not show
_COMMAND = "nerfbake "  # how each line of a plan begins
_REPORTS = (".html", ".md", ".csv")


def save_plan(state: str | Path, items: Sequence[Item]) -> None:
    """Write the command lines of the whole batch to its state, for the report after all shards have ended.

    A file of this name that is not a plan is not replaced. Raises OutputError.
    """
    path = Path(state) / "plan.txt"
    text = os.fsencode("".join(f"{item.line}\n" for item in items))
    require_no_link(path)
    if path.parent.is_file():
        raise OutputError("is a file; allowed: a new folder, or the state of a batch", source=str(state))
    with io.blame(str(path), OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.exists() and not _is_plan(path):
            raise OutputError("is not the plan of a batch; allowed: a new folder, or the state of a batch")
        with io.replacing(path, force=True) as file:
            file.write(text)


def _is_plan(path: Path) -> bool:
    """True if a file is empty or begins like a plan."""
    text = io.load_lines(path) if path.is_file() else "no file"
    return not text or text.startswith(_COMMAND)


def load_plan(state: str | Path) -> str:
    """Return the text that save_plan() wrote. Raises NerfbakeError."""
    path = Path(state) / "plan.txt"
    require_no_link(path)
    return io.load_lines(path)


def require_report(state: str | Path, path: str | Path | None) -> None:
    """Check that the report can be written. Call it before running items. A report of the same batch may be replaced.

    Raises UsageError for another file extension, and OutputError if the path cannot be written.
    """
    if path is None:
        return
    if Path(path).suffix not in _REPORTS:
        raise UsageError(f"the extension of {str(path)!r} is not that of a report; allowed: {', '.join(_REPORTS)}")
    io.require_absent(path, force=_is_own(state, path), parents=True)


def _is_own(state: str | Path, path: str | Path) -> bool:
    """True if a report of this batch has been written to the path."""
    own = str(Path(path).absolute())
    return any(event.get("report") == own for event in read_journal(Path(state) / "reports.jsonl"))


def write_report(batch: Batch, path: str | Path, *, state: str | Path) -> None:
    """Write a batch as a page (.html) or tables (.md, .csv), and replace its last report at this path.

    Raises UsageError for another file extension, and OutputError.
    """
    require_report(state, path)
    text = {".html": _page, ".md": as_markdown, ".csv": as_csv}[Path(path).suffix](batch)
    if not _is_own(state, path):
        journal = Journal(Path(state) / "reports.jsonl")
        journal.write({"report": str(Path(path).absolute())})
        journal.close()
    with io.blame(str(path), OutputError):
        Path(path).parent.mkdir(parents=True, exist_ok=True)
        with io.replacing(Path(path), force=True) as file:
            file.write(text.encode(errors="backslashreplace"))


def _page(batch: Batch) -> str:
    return as_page(batch, thumbnails(batch))


def thumbnails(batch: Batch) -> list[Thumbnail]:
    """Small pictures of the outputs, up to the limits of a page. Pictures that cannot be read are left out."""
    found: list[Thumbnail] = []
    remaining = BYTES
    for row in batch.rows:
        for output in row.attempt.outputs if row.attempt and row.status == DONE else ():
            if len(found) == THUMBNAILS or remaining <= 0:
                return found
            path = io.picture_in(output.path)
            if path is None or path.name.endswith(_NO_PICTURES):
                continue
            try:
                png = io.load_thumbnail(path, EDGE)
            except NerfbakeError:
                continue
            if len(png) <= remaining:
                found.append(Thumbnail(output.path, png))
                remaining -= len(png)
    return found


def snakefile() -> Path:
    """The path of the Snakefile that runs the shards of a batch."""
    return Path(__file__).with_name("Snakefile")
