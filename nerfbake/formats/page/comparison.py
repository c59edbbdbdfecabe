"""Write a comparison as one self-contained HTML page: verdict, numbers, file sizes and all pictures.

The page contains no script, no date and no external address, and its policy forbids them. So it can be mailed, archived
and compared with later pages. It has a light and a dark scheme, and is readable on phones and on paper. File names are
escaped. Every number is in a `data` element: rounded in its text, at full precision in its attribute `value`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import repeat
from pathlib import PurePath
from typing import Any

from nerfbake.errors import format_size
from nerfbake.formats.picture import png
from nerfbake.formats.wire.page import END, beginning, figure, picture, table, text
from nerfbake.scene.camera import rays_text
from nerfbake.scene.comparison import AMPLIFIED, Comparison, Verdict
from nerfbake.scene.image import Image

Sides = Mapping[str, Mapping[str, Any]]

_PAIRS = {"a_b": "A and B", "a_truth": "A and truth", "b_truth": "B and truth"}
_MEASURES = {"psnr": ("PSNR, dB", ".2f"), "ssim": ("SSIM", ".4f"), "max_error": ("largest error", ".4f")}
_BUDGETS = {
    "min_psnr": ("mean PSNR", ".2f", "&nbsp;dB", "at least"),
    "max_error": ("largest error", ".4f", "", "at most"),
}
_VALUES = {"sigma": "density, 1/world unit", "dc": "colour, first coefficient", "higher": "colour, higher bands"}
_PICTURES = {"truth": "truth"} | {
    pair: f"{words}: difference, {AMPLIFIED} times as strong" for pair, words in _PAIRS.items()
}
_ABOUT = (
    "PSNR, SSIM and errors are of sRGB in 0..1 over white, before it is rounded to 8 bits; 100 dB stands for equal "
    "pictures. All views: the mean PSNR and SSIM, and the largest error of all. Values are compared at the centres of "
    "A's leaves."
)


def encode(
    comparison: Comparison,
    *,
    a: Mapping[str, Any] | None = None,
    b: Mapping[str, Any] | None = None,
    min_psnr: float | None = None,
    max_error: float | None = None,
) -> Iterator[bytes]:
    """Yield the page in pieces, whether the budgets hold or not.

    a, b: facts about the two scenes by name (`name`, `bytes`, ...). min_psnr, max_error: the budgets of judge().
    """
    sides = {"a": {"name": "a scene", **(a or {})}, "b": {"name": "another", **(b or {})}}
    captions = _PICTURES | {side: f"{side.upper()}: {_short(facts)}" for side, facts in sides.items()}
    verdicts = comparison.judge(min_psnr=min_psnr, max_error=max_error)
    yield _document(comparison, sides, verdicts).encode()
    for view, row in zip(comparison.views, comparison.rows(), strict=False):
        yield _row(view["name"], row, captions).encode()
    yield f'<p class="about">{_ABOUT}</p>\n{END}'.encode()


def _document(comparison: Comparison, sides: Sides, verdicts: list[Verdict]) -> str:
    a, b = (_short(facts) for facts in sides.values())
    return f"""{beginning(f"{b} against {a}")}<h1>{b} <span>against {a}</span></h1>
{_headline(verdicts)}
{_tiles(comparison, sides)}
<h2>What was compared</h2>
<div class="facts">{table(["", "A", "B"], _facts(sides))}</div>
<h2>Pictures{rays_text(comparison.samples)}</h2>
<div class="pairs">{"".join(map(_pair, repeat(comparison), comparison.means))}</div>
<h2>Values of A and B</h2>
{_values(comparison)}
<h2>What it looks like</h2>
"""


def _headline(verdicts: list[Verdict]) -> str:
    if not verdicts:
        return '<p class="verdict">No budget was set.</p>'
    kept = all(verdict.holds for verdict in verdicts)
    kind, words = ("holds", "Within budget") if kept else ("missed", "Budget missed")
    lines = [f'<p class="verdict {kind}">{words}</p>', "<ul>"]
    for verdict in verdicts:
        name, digits, unit, bound = _BUDGETS[verdict.budget]
        found, allowed = figure(verdict.found, digits), figure(verdict.allowed, "g")
        end = "holds" if verdict.holds else "missed"
        lines.append(f"<li>{name} {found}{unit}, allowed {bound} {allowed}{unit}: {end}</li>")
    return "\n".join([*lines, "</ul>"])


def _tiles(comparison: Comparison, sides: Sides) -> str:
    mean = comparison.means["a_b"]
    tiles = {f"{'mean ' * (key != 'max_error')}{name}": (mean[key], d) for key, (name, d) in _MEASURES.items()}
    size_a, size_b = (facts.get("bytes") for facts in sides.values())
    if size_a and size_b:
        tiles["file size, B / A"] = size_b / size_a, ".1%"
    parts = [f"<div><dt>{name}</dt><dd>{figure(*found)}</dd></div>" for name, found in tiles.items()]
    return f"<dl>{''.join(parts)}</dl>"


def _facts(sides: Sides) -> Iterator[list[str]]:
    for key in dict.fromkeys(key for facts in sides.values() for key in facts):
        yield [key, *(_fact(key, facts.get(key)) for facts in sides.values())]


def _fact(key: str, value: Any) -> str:
    if value is None:
        return "not known"
    return f"{figure(value, ',')} ({format_size(value)})" if key == "bytes" else text(str(value))


def _pair(comparison: Comparison, pair: str) -> str:
    rows = [
        [text(view["name"]), *(figure(view[pair][key], digits) for key, (_, digits) in _MEASURES.items())]
        for view in (*comparison.views, {"name": "all views", **comparison.means})
    ]
    return table([_PAIRS[pair], *(name for name, _ in _MEASURES.values())], rows)


def _values(comparison: Comparison) -> str:
    if not comparison.values:
        return "<p>A and B hold values of different kinds; only their pictures are compared.</p>"
    found = comparison.values.items()
    rows = [[_VALUES[name], figure(errors["mean"], ".4g"), figure(errors["max"], ".4g")] for name, errors in found]
    return table(["", "mean error", "largest error"], rows)


def _row(name: str, pictures: Mapping[str, Image], captions: Mapping[str, str]) -> str:
    shown = []
    width, height = pictures["a"].size
    for key, image in pictures.items():
        shown.append(picture(b"".join(png.encode(image)), f' width="{width}" height="{height}"', captions[key]))
    head = f"<h3>{text(name)}, {width}x{height} pixels</h3>"
    return f'<section>\n{head}\n<div class="row">\n{"".join(shown)}</div>\n</section>\n'


def _short(facts: Mapping[str, Any]) -> str:
    return text(PurePath(facts["name"]).name)
