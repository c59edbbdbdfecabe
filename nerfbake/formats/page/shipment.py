"""Write the receipt of a shipment as one self-contained HTML page: figures, pictures of the worst views, programs.

The page has the parts and the style of the page of a comparison: no script, no date and no external address. Times
are the only figures that differ between two shipments of the same scene.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import PurePath

from nerfbake.formats.picture import png
from nerfbake.formats.wire.page import END, beginning, figure, picture, table, text
from nerfbake.scene.comparison import AMPLIFIED
from nerfbake.scene.shipment import Judgement, ReadingProgram, Shipment, ShippedFile

_STYLE = """<style>
a { color: inherit; }
.wide { overflow-x: auto; }
.wide td, .wide th { white-space: nowrap; }
.wide + table { margin-top: 1.25rem; }
.row { max-width: 50rem; margin-bottom: 1rem; }
.failed { color: var(--bad); font-weight: 600; }
section { border-top: 1px solid var(--line); margin-top: 2rem; }
section h2 { margin-top: 1.25rem; }
@media (max-width: 40rem) { .row { grid-template-columns: 1fr 1fr 1fr; gap: .3rem; } }
</style>
"""
_KNOWN = {"ran": "ran", "read": "its documentation says so", "not run": "not run"}
_ABOUT = (
    "PSNR and errors are of sRGB in 0..1 over white, before it is rounded to 8 bits; 100 dB stands for equal pictures. "
    "PSNR: the mean over the views. Worst view: the one with the lowest PSNR. Largest error: of any channel of any "
    "pixel of any view. Times are those of making a file, without the shared steps, without compiling and without "
    "judging. Ran: a file of nerfbake was opened in this version of the program. Not run: nobody has tried."
)


def encode(shipment: Shipment) -> Iterator[bytes]:
    """Yield the page in pieces."""
    name = text(PurePath(shipment.name).name)
    yield f"""{beginning(f"{name}: receipt").replace("</head>", f"{_STYLE}</head>")}<h1>{name} <span>for {
        text(", ".join(shipment.targets))
    }</span></h1>
{_headline(shipment)}
<p>{text(shipment.content)}. Judged on {text(shipment.views)}.</p>
<div class="wide">{table(_HEAD, map(_summary, shipment.files))}</div>
{_shared(shipment)}
""".encode()
    for file in shipment.files:
        yield _section(file).encode()
    yield f'<p class="about">{_ABOUT}</p>\n{END}'.encode()


_HEAD = ("file", "MB", "PSNR, dB", "worst view, dB", "largest error", "time", "for")


def _headline(shipment: Shipment) -> str:
    if not (failed := shipment.failed):
        return f'<p class="verdict holds">All files are there: {len(shipment.files)}</p>'
    names = ", ".join(text(file.name) for file in failed)
    return f'<p class="verdict missed">Failed: {names}</p>'


def _summary(file: ShippedFile) -> list[str]:
    link, targets = f'<a href="#{text(file.name)}">{text(file.name)}</a>', text(", ".join(file.targets))
    if file.status == "failed":
        return [link, '<span class="failed">failed</span>', "", "", "", "", targets]
    size, time = figure(file.bytes / 1e6, ".2f"), f"{figure(file.seconds, '.1f')} s"
    if (judged := file.judged) is None:
        return [link, size, "not judged", "", "", time, targets]
    worst = f"{figure(judged.worst_psnr, '.2f')} ({text(judged.worst)})"
    return [link, size, figure(judged.psnr, ".2f"), worst, figure(judged.max_error, ".3f"), time, targets]


def _shared(shipment: Shipment) -> str:
    if not shipment.shared:
        return ""
    rows = [
        [text(step.what), f"{figure(step.seconds, '.1f')} s", f"{figure(step.cpu_seconds, '.1f')} s"]
        for step in shipment.shared
    ]
    return table(["shared step", "time", "CPU time"], rows)


def _section(file: ShippedFile) -> str:
    head = f'<section id="{text(file.name)}">\n<h2>{text(file.name)}</h2>\n<p>{text(file.what)}</p>\n'
    if file.status == "failed":
        return f'{head}<p class="failed">Failed: {text(file.reason)}</p>\n</section>\n'
    judged = f"<p>Not judged: {text(file.reason)}</p>\n" if file.judged is None else _judged(file.name, file.judged)
    return f"{head}{judged}{table(['program', 'reads', 'known'], map(_reader, file.readers))}</section>\n"


def _judged(name: str, judged: Judgement) -> str:
    captions = ("the scene", text(name), f"difference, {AMPLIFIED} times as strong")
    shown = []
    for image, caption in zip(judged.pictures, captions, strict=True):
        width, height = image.size
        shown.append(picture(b"".join(png.encode(image)), f' width="{width}" height="{height}"', caption))
    told = f"{text(judged.by)}; worst view {text(judged.worst)}, {figure(judged.worst_psnr, '.2f')}&nbsp;dB"
    return f'<p>{told}</p>\n<div class="row">\n{"".join(shown)}</div>\n'


def _reader(reader: ReadingProgram) -> list[str]:
    return [text(f"{reader.program} {reader.version}".strip()), text(reader.reads), _KNOWN[reader.known]]
