"""Frame times of pages in a browser, in rounds that take turns: the layout that pages have against octree descents.

Pages are opened beside each other in one browser. In each round every page draws a picture from each camera, and the
next round begins with the next page; a first round does not count. What is told is the processor's time of the
browser's graphics: without a graphics card that is the whole work of a frame, and other programs do not add to it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

import nerfbake
from nerfbake import io
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics, seconds_of
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.bench.view.browser import OWN, Chromium, Tab, chromium
from nerfbake.bench.view.octree import octree_content, with_octree_lookup
from nerfbake.bench.view.published import CONTEXT
from nerfbake.errors import NerfbakeError
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.camera import Camera
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.page_field import PageField

EDGE = 400  # pixels
LEAST = 50  # dB: pictures of 8 bits are nearer than this
FRAMES = 5  # around the scene
OCTREE, CHOSEN = "octree from the root", "page: grid with distances, blocks of 4^3"
COLUMNS = ["page", "pixels", "structure MB", "ms a frame", "x octree", "wall ms a frame", "PSNR dB"]
NOTES = [
    "ms a frame: the processor's time of the browser's graphics on all cores, median [min..max] over rounds, each the "
    "mean of all cameras' pictures. Where a graphics card draws, it says little, and wall time counts.",
    "x octree: by that of the descent in the same round. PSNR: against `nerfbake render`; 100 for the same.",
    "octree from the root: eight children a node in two texels, a fetch a level; the marcher and the colours are the "
    "page's own. No frames a second are told: software draws them.",
]


def compare_pages(
    scene: N3Tree | SparseVoxelOctree,
    name: str,
    cameras: Sequence[Camera] = (),
    *,
    rounds: int,
    progress: Progress,
    flags: Sequence[str] = OWN,
    edge: int | None = None,
) -> Report:
    """Draws the scene with both lookups, and reports.

    cameras: by default an orbit of 5. flags: the browser's, which say what it draws with. edge: of the pictures, by
    default 400 pixels. Raises UsageError without Playwright, NerfbakeError where there is no browser, or where a page
    shows something else than it should.
    """
    edge = edge or EDGE
    octree = nerfbake.build_octree(scene) if isinstance(scene, N3Tree) else scene
    field = nerfbake.round_field(nerfbake.build_field(octree))
    views = tuple(cameras) or nerfbake.orbit_cameras(field, frames=FRAMES).cameras
    views = tuple(view.resized(edge, edge) for view in views)
    arranged = nerfbake.build_page_field(field)
    contents = {OCTREE: octree_content(field, arranged), CHOSEN: arranged}
    with progress("rendering"):
        truth = [nerfbake.render_field(field, view).colour for view in views]
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder, ExitStack() as stack:
        with progress("opening the pages"):
            browser = stack.enter_context(chromium(flags))
            pages = _written(field, name, nerfbake.Cameras(views), contents, Path(folder))
            tabs = {label: stack.enter_context(browser.opened(path)) for label, path in pages.items()}
            same = {label: _likeness(tab, views, edge, truth) for label, tab in tabs.items()}
        renderer = tabs[CHOSEN].renderer
        times = _times(browser, tabs, views, edge, rounds=rounds, progress=progress)
    rows = [_cells(label, contents[label], times, same[label], edge) for label in contents]
    head = {
        "scene": f"{name}: {octree}",
        "drawn by": renderer,
        "cameras": str(len(views)),
        "rounds": str(rounds),
        **environment("numpy", "playwright"),
    }
    return Report(f"Pages: {name}", head, [Table("Frames", COLUMNS, rows), *CONTEXT], NOTES)


def chart_pages(report: Report, suffix: str) -> bytes:
    """Time against memory, a point for each page."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    marks = [Mark(row["page"], row["structure MB"], row["ms a frame"].median, row["page"]) for row in rows]
    return scatter(marks, title=report.title, x="structure without colours, MB", y="ms a frame (median)", suffix=suffix)


def _written(
    field: nerfbake.RadianceField, name: str, views: nerfbake.Cameras, contents: Mapping[str, PageField], folder: Path
) -> dict[str, Path]:
    """Each page's file."""
    cover = nerfbake.render_field(field, views.cameras[0].resized(8, 8))
    pages = {label: folder / f"{number}.html" for number, label in enumerate(contents)}
    for label, path in pages.items():
        io.save(path, nerfbake.Page(contents[label], field, views, cover, name, turns=False))
    pages[OCTREE].write_bytes(with_octree_lookup(pages[OCTREE].read_bytes(), field))
    return pages


def _likeness(tab: Tab, views: Sequence[Camera], edge: int, truth: Sequence[Any]) -> float:
    """Mean PSNR in dB. Raises NerfbakeError for a page that draws something else: nothing is drawn fastest."""
    seen = tab.pictures(views, edge)
    found = float(np.mean([psnr(a / 255.0, b) for a, b in zip(seen, truth, strict=True)]))
    if found < LEAST:
        raise NerfbakeError(f"a page's pictures are {found:.1f} dB from `nerfbake render`; allowed: {LEAST:g} or more")
    return found


def _times(
    browser: Chromium, tabs: Mapping[str, Tab], views: Sequence[Camera], edge: int, *, rounds: int, progress: Progress
) -> dict[str, list[tuple[float, float]]]:
    """Of each page and round: the graphics' processor time and wall time of a frame, in ms."""
    found: dict[str, list[tuple[float, float]]] = {label: [] for label in tabs}
    order = list(tabs)
    for turn in range(rounds + 1):
        with progress(f"round {turn} of {rounds}" if turn else "a round that does not count"):
            for label in order:
                before = browser.graphics_seconds()
                _, wall = seconds_of(_drawing(tabs[label], views, edge))
                spent = browser.graphics_seconds() - before
                found[label].append((1e3 * spent / len(views), 1e3 * wall / len(views)))
        order = order[1:] + order[:1]
    return {label: times[1:] for label, times in found.items()}


def _drawing(tab: Tab, views: Sequence[Camera], edge: int) -> Callable[[], None]:
    return lambda: tab.draw(views, edge)


def _cells(
    label: str, content: PageField, times: Mapping[str, list[tuple[float, float]]], same: float, edge: int
) -> list[Any]:
    spent, wall = (Statistics.of(list(each)) for each in zip(*times[label], strict=True))
    ratios = [own / octree for (own, _), (octree, _) in zip(times[label], times[OCTREE], strict=True) if octree > 0]
    size = (content.top.nbytes * (label != OCTREE) + content.blocks.nbytes) / 1e6
    return [label, f"{edge}x{edge}", size, spent, Statistics.of(ratios) if ratios else None, wall, same]
