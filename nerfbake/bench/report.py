"""Write benchmark reports as Markdown, CSV or JSON, all with the same figures."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from nerfbake.bench.measure import Statistics
from nerfbake.errors import one_line
from nerfbake.io import versioned


class Table(NamedTuple):
    """columns: names with units. A cell is text, a number, Statistics, a bool, or None if nothing was measured."""

    title: str
    columns: list[str]
    rows: list[list[Any]]


class Report(NamedTuple):
    """head: the scene, the machine and versions by name. notes: explanations for the reader, a sentence each."""

    title: str
    head: dict[str, str]
    tables: list[Table]
    notes: list[str]


def markdown(report: Report) -> str:
    """Write Markdown, for people and for a README."""
    head = "; ".join(f"{name} {one_line(value)}" for name, value in report.head.items())
    parts = [f"# {report.title}", head, *map(_markdown_table, report.tables), *(f"- {note}" for note in report.notes)]
    return "\n\n".join(parts[: 2 + len(report.tables)]) + "\n\n" + "\n".join(parts[2 + len(report.tables) :]) + "\n"


def as_csv(report: Report) -> str:
    """Write CSV for spreadsheets: one row for each row of any table, with statistics as three columns."""
    rows = [row for table in report.tables for row in _records(table)]
    names = list(dict.fromkeys(name for row in rows for name in row))
    text = io.StringIO()
    writer = csv.DictWriter(text, names, lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    return text.getvalue()


def as_json(report: Report) -> str:
    """Write JSON with all contents, for scripts."""
    return _written(_facts(report))


WRITERS: dict[str, Callable[[Report], str]] = {"md": markdown, "csv": as_csv, "json": as_json}


def document(reports: Sequence[Report], kind: str) -> str:
    """Write reports in one of the kinds in WRITERS; several reports in JSON become the list `reports`."""
    if kind == "json" and len(reports) > 1:
        return _written({"reports": [_facts(report) for report in reports]})
    return "\n".join(WRITERS[kind](report) for report in reports)


def _written(facts: dict[str, Any]) -> str:
    return json.dumps(versioned(facts), indent=1) + "\n"


def _facts(report: Report) -> dict[str, Any]:
    tables = [{"title": table.title, "rows": _records(table)} for table in report.tables]
    return {"title": report.title, "head": report.head, "tables": tables, "notes": report.notes}


def _records(table: Table) -> list[dict[str, Any]]:
    records = []
    for row in table.rows:
        record: dict[str, Any] = {"table": table.title}
        for column, cell in zip(table.columns, row, strict=True):
            if isinstance(cell, Statistics):
                record |= {column: cell.median, f"{column} min": cell.low, f"{column} max": cell.high}
                record["rounds"] = cell.rounds
            else:
                record[column] = cell
        records.append(record)
    return records


def _markdown_table(table: Table) -> str:
    right = [
        any(isinstance(row[k], int | float | Statistics) and not isinstance(row[k], bool) for row in table.rows)
        for k in range(len(table.columns))
    ]
    lines = [table.columns, ["---:" if numeric else "---" for numeric in right]]
    lines += [[_cell(cell) for cell in row] for row in table.rows]
    return f"**{table.title}**\n\n" + "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _cell(cell: Any) -> str:
    match cell:
        case None:
            return "-"
        case bool():
            return "yes" if cell else "no"
        case Statistics():
            single = cell.rounds == 1
            return _number(cell.median) + ("" if single else f" [{_number(cell.low)}..{_number(cell.high)}]")
        case int():
            return f"{cell:,}"
        case float():
            return _number(cell)
        case _:
            return one_line(str(cell)).replace("|", "\\|")


def _number(value: float) -> str:
    """Format a number with three digits, or with all digits before the decimal point."""
    digits = max(0, 2 - len(str(int(abs(value)))) + 1) if value else 0
    return f"{value:,.{digits}f}"
