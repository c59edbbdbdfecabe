"""A batch's report as Markdown and CSV: an item a row."""

from __future__ import annotations

import csv
import io
from typing import Any

from nerfbake.batch.report import Batch, Row
from nerfbake.errors import one_line

COLUMNS = ("item", "status", "seconds", "peak MB", "MB in", "MB out", "ratio", "PSNR dB")


def figures(row: Row) -> list[float | None]:
    """What COLUMNS say of a row behind its status; None: it is not known."""
    attempt = row.attempt
    if attempt is None:
        return [None] * 6
    ratio = attempt.written / attempt.read if attempt.read and attempt.written else None
    return [attempt.seconds, attempt.peak / 1e6, attempt.read / 1e6, attempt.written / 1e6, ratio, attempt.psnr]


def rounded(values: list[float | None]) -> list[str]:
    """The same as text; '' for what is not known."""
    digits = (".2f", ".0f", ".2f", ".2f", ".1%", ".2f")
    return ["" if value is None else format(value, form) for value, form in zip(values, digits, strict=True)]


def as_csv(batch: Batch) -> str:
    """For spreadsheets: all that is known of each item, exactly."""
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(["command", "status", "exit", "error", "seconds", "peak_bytes", "bytes_in", "bytes_out", "psnr"])
    for row in batch.rows:
        writer.writerow([row.item.pasteable, row.status, *_exact(row)])
    return text.getvalue()


def _exact(row: Row) -> list[Any]:
    attempt = row.attempt
    if attempt is None:
        return [""] * 7
    psnr = "" if attempt.psnr is None else attempt.psnr
    return [attempt.code, one_line(attempt.error), attempt.seconds, attempt.peak, attempt.read, attempt.written, psnr]


def as_markdown(batch: Batch) -> str:
    """For people, and for pages that people keep: what is wrong stands first."""
    parts = ["# Batch", batch.told + ".", *(f"- {_cell(machine)}" for machine in batch.machines)]
    if faults := batch.faults:
        parts.append("## Not done")
        parts += [_fault(row) for row in faults]
    parts += ["## Items", _table(batch.rows)]
    for title, rows in batch.outstanding():
        parts += [f"## {title}", _table(rows)]
    return "\n\n".join(parts) + "\n"


def _fault(row: Row) -> str:
    error = f": {one_line(row.attempt.error)}" if row.attempt and row.attempt.error else ""
    return f"- {row.status}{_cell(error)}\n\n      {row.item.pasteable}"


def _table(rows: Any) -> str:
    lines = [COLUMNS, ("---", "---", *["---:"] * 6)]
    lines += [(_cell(row.item.name), row.status, *rounded(figures(row))) for row in rows]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(text: str) -> str:
    return "".join(f"\\{letter}" if letter in "\\|`*_<[&" else letter for letter in text)
