"""Frame times of nerf2mesh's stage 1 in a browser: the MLP with its weights in textures, as nerf2mesh's own viewer has
them, the MLP with its weights as constants, and the atlases baked from it, as the K-means thesis compares them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.bench.view.browser import OWN, Tab, chromium
from nerfbake.bench.view.comparison import EDGE, FRAMES, likeness
from nerfbake.bench.view.published import THESIS
from nerfbake.bench.view.timing import NOTE, frame_times
from nerfbake.scene.atlas import METHODS, BakedAtlas
from nerfbake.scene.camera import Camera
from nerfbake.scene.stage1 import Stage1

LEAST = 25  # dB: graphics round corners of triangles, so that a few pixels at the rim differ; nothing at all is less
MLPS = ("mlp_textures", "mlp_constants")
COLUMNS = ["highlights", "pixels", "textures MB", "ms a frame", "x kmeans", "wall ms a frame", "PSNR dB"]
NOTES = [
    NOTE,
    "x kmeans: by that of the kmeans atlas in the same round. none: the mesh with its diffuse colour alone. "
    "textures: what gives the highlights, uncompressed. PSNR: against `nerfbake compare`'s picture of the same scene, "
    "with one ray a pixel: what differs is the rim of the mesh.",
    "atlases are those of `nerfbake atlas --method M`. No frames a second are told: software draws them.",
]


def compare_surfaces(
    stage1: Stage1,
    name: str,
    cameras: Sequence[Camera] = (),
    *,
    rounds: int,
    progress: Progress,
    flags: Sequence[str] = OWN,
    edge: int | None = None,
    **baking: Any,
) -> Report:
    """Draws the scene with every way to its highlights, and reports.

    cameras: by default an orbit of 5. flags: the browser's, which say what it draws with. edge: of the pictures, by
    default 400 pixels. baking goes to bake_stage1(). Raises NerfbakeError as compare_pages() does.
    """
    edge = edge or EDGE
    views = tuple(cameras) or nerfbake.orbit_cameras(stage1, frames=FRAMES).cameras
    views = tuple(view.resized(edge, edge) for view in views)
    atlases: dict[str, BakedAtlas] = {}
    for method in METHODS:
        with progress(f"baking {method}"):
            atlases[method] = nerfbake.bake_stage1(stage1, method=method, **baking)
    scenes: dict[str, Stage1 | BakedAtlas] = {**dict.fromkeys(MLPS, stage1), **atlases}
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder, ExitStack() as stack:
        with progress("opening the pages"):
            browser = stack.enter_context(chromium(flags))
            pages = _written(stage1, name, nerfbake.Cameras(views), atlases, Path(folder))
            tabs: dict[str, Tab] = {each: stack.enter_context(browser.opened(path)) for each, path in pages.items()}
            # The MLP stands in the first page beside its atlas, and so does what has no highlights.
            tabs = {way: tabs.get(way, tabs["kmeans"]) for way in (*scenes, "none")}
            renderer = tabs["kmeans"].renderer
        with progress("rendering"):
            same = {
                way: likeness(
                    partial(tabs[way].pictures, views, edge, highlights=way),
                    [nerfbake.render_stage1(scene, view).colour for view in views],
                    least=LEAST,
                )
                for way, scene in scenes.items()
            }
        draws = {way: partial(tab.draw, views, edge, highlights=way) for way, tab in tabs.items()}
        times = frame_times(browser, draws, frames=len(views), rounds=rounds, progress=progress)
    rows = [
        [
            way,
            f"{edge}x{edge}",
            _megabytes(scenes.get(way)),
            Statistics.of(own.spent),
            own.ratio(times["kmeans"]),
            Statistics.of(own.wall),
            same.get(way),
        ]
        for way, own in times.items()
    ]
    head = {
        "scene": f"{name}: {stage1}",
        "drawn by": renderer,
        "cameras": str(len(views)),
        "rounds": str(rounds),
        **environment("numpy", "playwright"),
    }
    return Report(f"Pages: {name}", head, [Table("Frames", COLUMNS, rows), THESIS], NOTES)


def _written(
    stage1: Stage1, name: str, views: nerfbake.Cameras, atlases: Mapping[str, BakedAtlas], folder: Path
) -> dict[str, Path]:
    """A page for each atlas, each with the MLP beside it."""
    cover = nerfbake.render_stage1(stage1, views.cameras[0].resized(8, 8))
    pages = {method: folder / f"{method}.html" for method in atlases}
    for method, atlas in atlases.items():
        surface = nerfbake.build_page_surface(atlas, stage1=stage1)
        io.save(pages[method], nerfbake.Page(surface, None, views, cover, name, turns=False))
    return pages


def _megabytes(scene: Stage1 | BakedAtlas | None) -> float | None:
    """Of the textures that give the highlights; labels take a byte up to 256 maps, else two."""
    if scene is None:
        return None
    if isinstance(scene, Stage1):
        return sum(field.features.nbytes for field in scene.fields) / 1e6
    size = 0
    for atlas in scene.atlases:
        label = 0 if atlas.method == "grid" else 1 if atlas.K <= 256 else 2
        size += atlas.image.nbytes + (label + 3 * (atlas.features is not None)) * atlas.labels.size
    return size / 1e6
