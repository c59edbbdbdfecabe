"""Files of a batch beside its events: the plan, and reports."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from nerfbake import io
from nerfbake.batch.items import Item
from nerfbake.batch.page import Thumbnail, as_page
from nerfbake.batch.report import Batch
from nerfbake.batch.state import DONE
from nerfbake.batch.tables import as_csv, as_markdown
from nerfbake.errors import NerfbakeError, OutputError, UsageError
from nerfbake.io.journal import Journal, read_journal
from nerfbake.io.own_files import require_no_link

THUMBNAILS, EDGE, BYTES = 48, 192, 2_000_000  # of a page: at most so many pictures, of such edges, of so many bytes
_NO_PICTURES = (".depth.png", ".alpha.png")
_REPORTS = (".html", ".md", ".csv")


def save_plan(state: str | Path, items: Sequence[Item]) -> None:
    """Keeps the lines of a whole batch in its state, for whoever judges it when all shards are done."""
    path = Path(state) / "plan.txt"
    text = os.fsencode("".join(f"{item.line}\n" for item in items))
    require_no_link(path)
    with io.blame(str(path), OutputError):
        path.parent.mkdir(parents=True, exist_ok=True)
        with io.replacing(path, force=True) as file:
            file.write(text)


def load_plan(state: str | Path) -> str:
    """The lines that save_plan() has kept. Raises NerfbakeError."""
    path = Path(state) / "plan.txt"
    require_no_link(path)
    return io.load_lines(path)


def require_report(state: str | Path, path: str | Path | None) -> None:
    """Raises, before anything runs, where the report could not be written; one of the same batch is replaced."""
    if path is None:
        return
    if Path(path).suffix not in _REPORTS:
        raise UsageError(f"the ending of {str(path)!r} names no report; allowed: {', '.join(_REPORTS)}")
    io.require_absent(path, force=_is_ours(state, path), parents=True)


def _is_ours(state: str | Path, path: str | Path) -> bool:
    """True if a report of this batch has been written there."""
    ours = str(Path(path).absolute())
    return any(event.get("report") == ours for event in read_journal(Path(state) / "reports.jsonl"))


def write_report(batch: Batch, path: str | Path, *, state: str | Path) -> None:
    """Writes what came of a batch as a page (.html) or a table (.md, .csv), in place of its last report.

    Raises UsageError for another ending, OutputError.
    """
    require_report(state, path)
    text = {".html": _page, ".md": as_markdown, ".csv": as_csv}[Path(path).suffix](batch)
    if not _is_ours(state, path):
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
    """Small pictures of what was written, as many as a page should hold; one that cannot be read is left out."""
    found: list[Thumbnail] = []
    room = BYTES
    for row in batch.rows:
        for output in row.attempt.outputs if row.attempt and row.status == DONE else ():
            if len(found) == THUMBNAILS or room <= 0:
                return found
            path = io.picture_in(output.path)
            if path is None or path.name.endswith(_NO_PICTURES):
                continue
            try:
                png = io.load_thumbnail(path, EDGE)
            except NerfbakeError:
                continue
            if len(png) <= room:
                found.append(Thumbnail(output.path, png))
                room -= len(png)
    return found


def snakefile() -> Path:
    """Where the package keeps the Snakefile that runs a batch's shards."""
    return Path(__file__).with_name("Snakefile")
