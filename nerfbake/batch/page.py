"""A batch's report as one page that needs nothing else: what is wrong first, then every item, with small pictures."""

from __future__ import annotations

import html
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from nerfbake.batch.report import Batch, Row
from nerfbake.batch.state import DONE
from nerfbake.batch.tables import COLUMNS, figures
from nerfbake.errors import format_size
from nerfbake.formats.wire.page_pieces import END, beginning, figure, picture, table, text

_DIGITS = (".2f", ",.0f", ",.2f", ",.2f", ".1%", ".2f")
_WRAPPED = "white-space: pre-wrap; overflow-wrap: anywhere"
_ABOUT = (
    "Seconds and peaks are those of each item's own process. The ratio is of what it wrote to what it read. PSNR is "
    "what the command itself said of its output. An item that waits has not been tried as it is now."
)


class Thumbnail(NamedTuple):
    """A small picture of an output: the output's name, and a PNG."""

    name: str
    png: bytes


def as_page(batch: Batch, thumbnails: Sequence[Thumbnail] = ()) -> str:
    """The page. The same batch gives the same bytes."""
    return "".join(_parts(batch, thumbnails))


def _parts(batch: Batch, thumbnails: Sequence[Thumbnail]) -> Iterator[str]:
    yield beginning("Batch")
    kind, words = ("holds", "All done") if not batch.exit_code else ("missed", "Not all done")
    yield f'<h1>Batch <span>of {len(batch.rows):,}</span></h1>\n<p class="verdict {kind}">{words}</p>\n'
    yield _tiles(batch)
    if batch.faults:
        yield f"<h2>Not done</h2>\n{''.join(map(_fault, batch.faults))}"
    if thumbnails:
        pictures = "".join(picture(each.png, "", text(each.name)) for each in thumbnails)
        yield f'<h2>Pictures</h2>\n<div class="row">\n{pictures}</div>\n'
    for title, rows in batch.outstanding():
        yield f"<h2>{title}</h2>\n{_table(rows)}"
    yield f"<h2>Items</h2>\n{_table(batch.rows)}"
    machines = "".join(f"<li>{text(machine)}</li>" for machine in batch.machines)
    yield f'<h2>Where it ran</h2>\n<ul>{machines}</ul>\n<p class="about">{_ABOUT}</p>\n{END}'


def _tiles(batch: Batch) -> str:
    totals = batch.totals
    tiles = {status: figure(count, ",") for status, count in batch.counts.items()}
    tiles |= {"seconds of processes": figure(totals.seconds, ",.1f"), "read": _size(totals.read)}
    tiles |= {"written": _size(totals.written), "largest peak": _size(totals.peak)}
    return f"<dl>{''.join(f'<div><dt>{name}</dt><dd>{told}</dd></div>' for name, told in tiles.items())}</dl>\n"


def _size(count: int) -> str:
    return f'<data value="{count}">{format_size(count)}</data>'


def _fault(row: Row) -> str:
    """What went wrong, and the command to paste: whole, however long it is."""
    error = f": {text(row.attempt.error)}" if row.attempt and row.attempt.error else ""
    code = f" (exit {row.attempt.code})" if row.attempt else ""
    command = f'<pre style="{_WRAPPED}">{html.escape(row.item.pasteable)}</pre>'
    return f'<section>\n<p class="missed">{row.status}{code}{error}</p>\n{command}\n</section>\n'


def _table(rows: Sequence[Row]) -> str:
    return f'<div style="overflow-x: auto">{table(COLUMNS, map(_cells, rows))}</div>\n'


def _cells(row: Row) -> list[str]:
    status = row.status if row.status == DONE else f"<strong>{row.status}</strong>"
    told = ("" if value is None else figure(value, form) for value, form in zip(figures(row), _DIGITS, strict=True))
    return [text(row.item.name), status, *told]
