"""What pages that tell of something share: their head, tables, and text and figures in them.

No script, no date, no address of anything outside (and a policy that forbids them). Whatever a file is called, it is
text. Every figure stands in a `data` element, rounded for people, whole in its `value`.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape

from nerfbake.errors import one_line
from nerfbake.formats.wire.page_style import STYLE

_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
END = "</main>\n</body>\n</html>\n"


def beginning(title: str) -> str:
    """All that stands before what a page says; title: as it stands in a page."""
    return f"""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta http-equiv="Content-Security-Policy" content="{_POLICY}">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>{title}</title>
<style>{STYLE}</style>
</head>
<body>
<main>
"""


def table(head: Iterable[str], rows: Iterable[Iterable[str]]) -> str:
    """The first cell of a row is what the row is about; all of them as they stand in a page."""
    lines = ["<tr>" + "".join(f'<th scope="col">{cell}</th>' for cell in head) + "</tr>"]
    for first, *cells in rows:
        body = "".join(f"<td>{cell}</td>" for cell in cells)
        lines.append(f'<tr><th scope="row">{first}</th>{body}</tr>')
    body = "\n".join(lines[1:])
    return f"<table>\n<thead>{lines[0]}</thead>\n<tbody>\n{body}\n</tbody>\n</table>\n"


def figure(value: float, digits: str) -> str:
    """A figure, with so many digits."""
    return f'<data value="{value!r}">{value:{digits}}</data>'


def picture(png: bytes, size: str, caption: str) -> str:
    """A picture within the page, and what stands below it; size: its attributes."""
    data = base64.b64encode(png).decode()
    image = f'<img src="data:image/png;base64,{data}"{size} alt="{caption}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>\n"


def text(words: str) -> str:
    """Anything at all as text in a page, or in an attribute of one."""
    return escape(one_line(words))
