"""HTML parts of report pages: head, style, tables, numbers, pictures and text.

The pages contain no script, no date and no external address, and their policy forbids them. File names are escaped.
Every number is in a `data` element: rounded in its text, at full precision in its attribute `value`.

The style is plain: one column, a light and a dark scheme, and rules for printing.
"""

from __future__ import annotations

import base64
from collections.abc import Iterable
from html import escape

from nerfbake.errors import one_line

STYLE = """
:root {
  --ink: #1b1f24; --soft: #59626d; --line: #d5dae0; --paper: #fff; --plate: #f4f6f8; --good: #11693a; --bad: #b3261e;
}
@media screen and (prefers-color-scheme: dark) {
  :root {
    --ink: #e8eaed; --soft: #a3acb6; --line: #3a424b; --paper: #15181c; --plate: #1f242a;
    --good: #6fd39b; --bad: #ff8f87;
  }
}
* { box-sizing: border-box; }
body { margin: 0; background: var(--paper); color: var(--ink); font: 16px/1.5 system-ui, sans-serif; }
main { max-width: 80rem; margin: 0 auto; padding: 1.5rem 1rem 3rem; }
h1, h2, h3 { line-height: 1.25; overflow-wrap: anywhere; }
h1 { font-size: 1.6rem; margin: 0 0 .75rem; }
h1 span { color: var(--soft); font-weight: 400; }
h2 { font-size: 1.15rem; margin: 2.25rem 0 .6rem; }
h3 { font-size: .95rem; margin: 1.25rem 0 .4rem; color: var(--soft); font-weight: 600; }
ul { margin: .4rem 0 0; padding-left: 1.2rem; }
.verdict { margin: 0; font-size: 1.15rem; color: var(--soft); }
.holds, .missed { padding-left: .7rem; border-left: .3rem solid; font-weight: 600; }
.holds { color: var(--good); }
.missed { color: var(--bad); }
dl, .row { display: grid; grid-template-columns: repeat(auto-fit, minmax(9rem, 1fr)); gap: .6rem; }
dl { margin: 1.25rem 0 0; }
dl div { background: var(--plate); border-radius: .5rem; padding: .6rem .9rem; }
dt { color: var(--soft); font-size: .85rem; }
dd { margin: 0; font-size: 1.5rem; font-weight: 600; font-variant-numeric: tabular-nums; }
table { border-collapse: collapse; font-variant-numeric: tabular-nums; }
th, td { padding: .35rem 1rem .35rem 0; text-align: left; vertical-align: top; border-bottom: 1px solid var(--line); }
thead th { color: var(--soft); font-size: .85rem; font-weight: 600; vertical-align: bottom; }
tbody th { font-weight: 400; }
data { white-space: nowrap; }
.facts table { width: 100%; table-layout: fixed; overflow-wrap: anywhere; }
.facts th:first-child { width: 5.5rem; }
.pairs { display: flex; flex-wrap: wrap; gap: 1.25rem 2rem; overflow-x: auto; }
.pairs thead th:first-child { color: var(--ink); }
.pairs tr:last-child > * { font-weight: 600; }
figure { margin: 0; }
img { display: block; width: 100%; height: auto; background: #fff; border: 1px solid var(--line); }
figcaption { color: var(--soft); font-size: .8rem; margin-top: .2rem; overflow-wrap: anywhere; }
.about { color: var(--soft); font-size: .85rem; margin-top: 2.5rem; max-width: 50rem; }
@media (max-width: 40rem) { dl { grid-template-columns: 1fr 1fr; } }
@media print {
  main { max-width: none; padding: 0; }
  section, tr, dl div { break-inside: avoid; }
  h2 { break-after: avoid; }
}
"""


_POLICY = "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
END = "</main>\n</body>\n</html>\n"


def beginning(title: str) -> str:
    """Return the beginning of a page, up to its content. title: escaped."""
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
    """Return a table. The first cell of each row is its heading; all cells are escaped already."""
    heads = "".join(f'<th scope="col">{cell}</th>' for cell in head)
    body = "\n".join(
        f'<tr><th scope="row">{first}</th>{"".join(f"<td>{cell}</td>" for cell in cells)}</tr>'
        for first, *cells in rows
    )
    return f"<table>\n<thead><tr>{heads}</tr></thead>\n<tbody>\n{body}\n</tbody>\n</table>\n"


def figure(value: float, digits: str) -> str:
    """Return a number in a `data` element; digits: the format of its text."""
    return f'<data value="{value!r}">{value:{digits}}</data>'


def picture(png: bytes, size: str, caption: str) -> str:
    """Return an embedded picture with a caption below it. size: attributes of the img element."""
    data = base64.b64encode(png).decode()
    image = f'<img src="data:image/png;base64,{data}"{size} alt="{caption}">'
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>\n"


def text(words: str) -> str:
    """Escape any text for the page and for attributes."""
    return escape(one_line(words))
