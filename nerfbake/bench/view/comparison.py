"""Frame times of pages in a browser, in rounds that take turns: the layout that pages have against octree descents."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt

import nerfbake
from nerfbake import io
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.bench.view.browser import OWN, chromium
from nerfbake.bench.view.octree import octree_content, with_octree_lookup
from nerfbake.bench.view.published import REPORT, THESIS
from nerfbake.bench.view.timing import NOTE, Times, frame_times
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
    NOTE,
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
            same = {label: likeness(partial(tab.pictures, views, edge), truth) for label, tab in tabs.items()}
        renderer = tabs[CHOSEN].renderer
        draws = {label: partial(tab.draw, views, edge) for label, tab in tabs.items()}
        times = frame_times(browser, draws, frames=len(views), rounds=rounds, progress=progress)
    rows = [_cells(label, contents[label], times, same[label], edge) for label in contents]
    head = {
        "scene": f"{name}: {octree}",
        "drawn by": renderer,
        "cameras": str(len(views)),
        "rounds": str(rounds),
        **environment("numpy", "playwright"),
    }
    return Report(f"Pages: {name}", head, [Table("Frames", COLUMNS, rows), REPORT, THESIS], NOTES)


def chart_pages(report: Report, suffix: str) -> bytes:
    """Time against memory, a point for each row that has some."""
    frames = report.tables[0]
    marks = [Mark(page, size, spent.median, page) for page, _, size, spent, *_ in frames.rows if size is not None]
    return scatter(marks, title=report.title, x=frames.columns[2], y="ms a frame (median)", suffix=suffix)


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


def likeness(
    pictures: Callable[[], Sequence[npt.NDArray[np.uint8]]], truth: Sequence[Any], *, least: float = LEAST
) -> float:
    """Mean PSNR in dB. Raises NerfbakeError for a page that draws something else: nothing is drawn fastest."""
    found = float(np.mean([psnr(a / 255.0, b) for a, b in zip(pictures(), truth, strict=True)]))
    if found < least:
        raise NerfbakeError(f"a page's pictures are {found:.1f} dB from `nerfbake render`; allowed: {least:g} or more")
    return found


def _cells(label: str, content: PageField, times: Mapping[str, Times], same: float, edge: int) -> list[Any]:
    own = times[label]
    size = (content.top.nbytes * (label != OCTREE) + content.blocks.nbytes) / 1e6
    ratio, wall = own.ratio(times[OCTREE]), Statistics.of(own.wall)
    return [label, f"{edge}x{edge}", size, Statistics.of(own.spent), ratio, wall, same]
