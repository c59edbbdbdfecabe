"""Benchmark of interactive pages: size, baking time, time to the first picture, and frame times in a browser.

The aims are for a page of the real chair at 256^3 that is small enough to mail: bytes, additional seconds compared with
`compress` or `svo`, seconds from opening to the first ray-marched picture without a graphics card, the script's decoder
relative to Python's, and frame times. The pages take turns, round by round.

compare_pages() compares the layout of nerfbake's pages with an octree whose shader descends from the root for each
voxel, as in TR-24-01. compare_surfaces() compares the highlights of nerf2mesh's stage 1 as in the K-means thesis: the
MLP with its weights in textures (as in nerf2mesh's viewer), the MLP with its weights as constants, and the atlases
baked from it. Its scene is a sample with an MLP as large as a real one. Published frame rates are shown as context;
docs/sources.md has the titles.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import nerfbake
from benchmarks.aims import VIEW, aims_table
from benchmarks.browser import LLVMPIPE, NOTE, OWN, SWIFTSHADER, Tab, Times, chromium, frame_times
from benchmarks.processes import announced, in_turn, measure_process
from benchmarks.scenes import Scenes
from nerfbake import io, load
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Progress, Statistics, seconds_of
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.report import Report, Table
from nerfbake.errors import NerfbakeError
from nerfbake.kernels.march.cells import EMPTY, rows_at
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.scene.atlas import METHODS, BakedAtlas
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.page import PageField, grid_of
from nerfbake.scene.radiance_field import RadianceField, leaves_of
from nerfbake.scene.stage1 import Stage1

# dB: the rasteriser rounds triangle corners, so that a few pixels at the rim differ; an empty picture has less
LEAST_SURFACES = 25
MLPS = ("mlp_textures", "mlp_constants")
SURFACE_COLUMNS = ["highlights", "pixels", "textures MB", "ms a frame", "x kmeans", "wall ms a frame", "PSNR dB"]
SURFACE_NOTES = [
    NOTE,
    "x kmeans: ratio to the kmeans atlas in the same round. none: the mesh with its diffuse colour only. "
    "textures: those of the highlights, uncompressed. PSNR: against the picture of `nerfbake compare` of the same "
    "scene, with one ray a pixel; differences are at the rim of the mesh.",
    "The atlases are those of `nerfbake atlas --method M`. Frames a second are not reported: software draws them.",
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
    """Draw the scene with every method for highlights, and return the report.

    cameras: by default an orbit of 5. flags: options of the browser that select its renderer. edge: of the pictures, by
    default 400 pixels. baking: options of bake_stage1(). Raises NerfbakeError in the same cases as compare_pages().
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
            pages = _written_stage1(stage1, name, nerfbake.Cameras(views), atlases, Path(folder))
            tabs: dict[str, Tab] = {each: stack.enter_context(browser.opened(path)) for each, path in pages.items()}
            # Every page contains the MLP with its atlas. The MLP and `none` are drawn in the page of kmeans.
            tabs = {way: tabs.get(way, tabs["kmeans"]) for way in (*scenes, "none")}
            renderer = tabs["kmeans"].renderer
        with progress("rendering"):
            same = {
                way: likeness(
                    partial(tabs[way].pictures, views, edge, highlights=way),
                    [nerfbake.render_stage1(scene, view).colour for view in views],
                    least=LEAST_SURFACES,
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
    return Report(f"Pages: {name}", head, [Table("Frames", SURFACE_COLUMNS, rows), THESIS], SURFACE_NOTES)


def _written_stage1(
    stage1: Stage1, name: str, views: nerfbake.Cameras, atlases: Mapping[str, BakedAtlas], folder: Path
) -> dict[str, Path]:
    """Write a page for each atlas, each with the MLP."""
    cover = nerfbake.render_stage1(stage1, views.cameras[0].resized(8, 8))
    pages = {method: folder / f"{method}.html" for method in atlases}
    for method, atlas in atlases.items():
        surface = nerfbake.build_page_surface(atlas, stage1=stage1)
        io.save(pages[method], nerfbake.Page(surface, None, views, cover, name, turns=False))
    return pages


def _megabytes(scene: Stage1 | BakedAtlas | None) -> float | None:
    """The size of the textures of the highlights; labels take a byte up to 256 maps, else two."""
    if scene is None:
        return None
    if isinstance(scene, Stage1):
        return sum(field.features.nbytes for field in scene.fields) / 1e6
    size = 0
    for atlas in scene.atlases:
        label = 0 if atlas.method == "grid" else 1 if atlas.K <= 256 else 2
        size += atlas.image.nbytes + (label + 3 * (atlas.features is not None)) * atlas.labels.size
    return size / 1e6


_LOOK = re.compile(rb"^int look\(.*?^}\n", re.MULTILINE | re.DOTALL)


def octree_content(field: RadianceField, arranged: PageField) -> PageField:
    """Replace the blocks of 4^3 by the octree's nodes with two texels a node; the colours are the same.

    field: the field of an octree, with two children along each axis.
    """
    start, _ = grid_of(field.box)
    rows = np.full(len(field.values), -1, np.int64)
    for corners, _ in leaves_of(field.cells):
        middles = corners + 0.5
        rows[rows_at(field.cells, middles)] = arranged.rows(middles - start)
    slots, leaf = field.cells.slots, field.cells.slots < EMPTY
    numbers = rows[-2 - slots[leaf]]
    table = slots.copy()
    table[leaf] = np.where(numbers < 0, EMPTY, -2 - numbers)
    # Blocks come in groups of eight, so the table is padded with empty entries.
    blocks = np.pad(table.reshape(-1, 4), ((0, -(len(table) // 4) % 8), (0, 0)), constant_values=EMPTY)
    return replace(arranged, blocks=blocks.view(np.uint32))


def with_octree_lookup(page: bytes, field: RadianceField) -> bytes:
    """Return a page of octree_content() with the lookup for octrees in its shader."""
    source = (Path(__file__).parent / "shaders" / "octree.glsl").read_bytes()
    x, y, z = grid_of(field.box)[0].tolist()
    head = f"const int HEIGHT = {len(field.cells.bits)};\nconst ivec3 START = ivec3({x}, {y}, {z});\n"
    changed, count = _LOOK.subn((head.encode() + source).replace(b"\\", b"\\\\"), page)
    assert count == 1, "the page's shader has no lookup of its own"
    return changed


REPORT = Table(
    "TR-24-01, table 3, as context: frames a second at 800x800, Unity's preview, Ryzen 5 5600 and RX 6700 XT",
    ["scene", "128^3", "256^3"],
    [["chair", 317.9, None], ["lego", 205.0, 153.5], ["hot dog", 204.5, 156.3], ["microphone", 280.0, 214.9]],
)
THESIS = Table(
    "The thesis, section 3.1, as context: frames a second before and after its atlas",
    ["program", "MLP, weights in textures", "atlas"],
    [["Unity", 47, 200], ["WebGL", 280, 800]],
)


EDGE = 400  # pixels
LEAST = 50  # dB: pictures of 8 bits reach more than this
FRAMES = 5  # cameras around the scene
OCTREE, CHOSEN = "octree from the root", "page: grid with distances, blocks of 4^3"
COLUMNS = ["page", "pixels", "structure MB", "ms a frame", "x octree", "wall ms a frame", "PSNR dB"]
NOTES = [
    NOTE,
    "x octree: ratio to the octree from the root in the same round. PSNR: against `nerfbake render`; 100 for equal "
    "pictures.",
    "octree from the root: eight children a node in two texels, a fetch for each level; the marcher and the colours "
    "are the same as in the page. Frames a second are not reported: software draws them.",
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
    """Draw the scene with both lookups, and return the report.

    cameras: by default an orbit of 5. flags: options of the browser that select its renderer. edge: of the pictures, by
    default 400 pixels. Raises UsageError without Playwright, NerfbakeError if there is no browser or a page draws a
    wrong picture.
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
    """Plot time against memory, with a point for each row that has a size."""
    frames = report.tables[0]
    marks = [Mark(page, size, spent.median, page) for page, _, size, spent, *_ in frames.rows if size is not None]
    return scatter(marks, title=report.title, x=frames.columns[2], y="ms a frame (median)", suffix=suffix)


def _written(
    field: nerfbake.RadianceField, name: str, views: nerfbake.Cameras, contents: Mapping[str, PageField], folder: Path
) -> dict[str, Path]:
    """Write the pages, and return their files."""
    cover = nerfbake.render_field(field, views.cameras[0].resized(8, 8))
    pages = {label: folder / f"{number}.html" for number, label in enumerate(contents)}
    for label, path in pages.items():
        io.save(path, nerfbake.Page(contents[label], field, views, cover, name, turns=False))
    pages[OCTREE].write_bytes(with_octree_lookup(pages[OCTREE].read_bytes(), field))
    return pages


def likeness(
    pictures: Callable[[], Sequence[npt.NDArray[np.uint8]]], truth: Sequence[Any], *, least: float = LEAST
) -> float:
    """Return the mean PSNR in dB. Raises NerfbakeError below `least`: a page that draws nothing would be fastest."""
    found = float(np.mean([psnr(a / 255.0, b) for a, b in zip(pictures(), truth, strict=True)]))
    if found < least:
        raise NerfbakeError(f"a page's pictures are {found:.1f} dB from `nerfbake render`; allowed: {least:g} or more")
    return found


def _cells(label: str, content: PageField, times: Mapping[str, Times], same: float, edge: int) -> list[Any]:
    own = times[label]
    size = (content.top.nbytes * (label != OCTREE) + content.blocks.nbytes) / 1e6
    ratio, wall = own.ratio(times[OCTREE]), Statistics.of(own.wall)
    return [label, f"{edge}x{edge}", size, Statistics.of(own.spent), ratio, wall, same]


ROUNDS = 3
TEXELS = 512  # texels along an edge of the sample's textures
EDGE = 400  # pixels
# The page begins a second drawing only after the first is complete.
FIRST = "nerfbake.frames > 1 || nerfbake.finished"
# Without the pauses that keep a page responsive: in a hidden page, each timer can take a second.
DECODE = "(nerfbake.carried.tell = async () => undefined, nerfbake.carried.arrays().then(() => 0))"
RENDERERS = {"SwiftShader": SWIFTSHADER, "llvmpipe": LLVMPIPE}
PAGE_NOTES = [
    "baking: time of the process `nerfbake view` minus that of `nerfbake compress` or `nerfbake svo`, same round.",
    "first picture: from opening the file in a fresh browser to the first complete drawing, at 400x400, drawn by "
    "SwiftShader. decoding: in the script from the page's text to the shader's arrays, in Python from the .svoq to the "
    "octree.",
]


class Made(NamedTuple):
    """The files, and for each round the additional seconds of a page compared with `compress` or `svo`."""

    compressed: Path
    exact: Path
    svoq: Path
    compressing: list[float]
    resampling: list[float]


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        made = _baked(scenes.chair, Path(folder), rounds)
        with announced("first pictures"):
            first = [_first_picture(made.compressed) for _ in range(rounds)]
        with announced("decoding"):
            script, python = _decoding(made.compressed, made.svoq, rounds)
        sizes = [path.stat().st_size / 1e6 for path in (made.compressed, made.exact)]
    ratios = [own / other for own, other in zip(script, python, strict=True)]
    costs = Table(
        "Pages",
        ["page", "MB", "baking, s more", "first picture s", "decoding s", "Python's decoder s", "x Python's"],
        [
            ["compressed", sizes[0], *map(Statistics.of, (made.compressing, first, script, python, ratios))],
            ["exact", sizes[1], Statistics.of(made.resampling), None, None, None, None],
        ],
    )
    figures: dict[str, float | None] = {
        "compressed: MB": sizes[0],
        "exact: MB": sizes[1],
        "baking, compressed: s more than `compress`": Statistics.of(made.compressing).median,
        "baking, exact: s more than `svo`": Statistics.of(made.resampling).median,
        "first picture, compressed, SwiftShader: s": Statistics.of(first).median,
        "decoding in the script: x Python's": Statistics.of(ratios).median,
    }
    views = load(scenes.views / "transforms.json", Cameras).cameras
    tree, frames = load(scenes.chair, N3Tree), []
    for name, flags in RENDERERS.items():
        found = compare_pages(tree, scenes.chair.name, views, rounds=rounds, progress=announced, flags=flags, edge=EDGE)
        frames.append(found._replace(title=f"{found.title}, drawn by {name}"))
        figures[f"frames, {name}: x octree"] = _ratio(found, COLUMNS.index("x octree"), CHOSEN)
    stage1 = nerfbake.sample_stage1(resolution=TEXELS)
    for name, flags in RENDERERS.items():
        scene = f"sample of nerf2mesh, {TEXELS}x{TEXELS} texels"
        found = compare_surfaces(stage1, scene, rounds=rounds, progress=announced, flags=flags, edge=EDGE)
        frames.append(found._replace(title=f"{found.title}, drawn by {name}"))
        ratio = _ratio(found, SURFACE_COLUMNS.index("x kmeans"), "mlp_textures")
        figures[f"frames of the MLP, {name}: x atlas"] = ratio
    aims = aims_table([(what, aim, figures.get(what)) for what, aim in VIEW.items()])
    head = {"scene": scenes.chair.name, "rounds": str(rounds), **environment("numpy", "numba", "playwright")}
    return {"view": [Report("Interactive pages", head, [aims, costs], PAGE_NOTES), *frames]}


def _ratio(report: Report, column: int, page: str) -> float | None:
    """The median of a page; None if there is none."""
    found = next(row[column] for row in report.tables[0].rows if row[0] == page)
    return found.median if found else None


def _baked(chair: Path, folder: Path, rounds: int) -> Made:
    """Measure `view`, `compress` and `svo` as whole processes that take turns."""
    files = {name: folder / name for name in ("a.html", "a.svoq", "b.html", "b.svo.npz")}

    def timed(command: str, name: str, *options: str) -> float:
        with announced(f"nerfbake {command}: {name}"):
            line = command, str(chair), str(files[name]), *options, "--force", "-q"
            return measure_process(sys.executable, "-m", "nerfbake", *line).seconds

    own, packed, exact, octree = in_turn(
        lambda: timed("view", "a.html"),
        lambda: timed("compress", "a.svoq"),
        lambda: timed("view", "b.html", "--data", "exact"),
        lambda: timed("svo", "b.svo.npz"),
        rounds=rounds,
    )
    more = [[a - b for a, b in zip(*pair, strict=True)] for pair in ((own, packed), (exact, octree))]
    return Made(files["a.html"], files["b.html"], files["a.svoq"], *more)


def _first_picture(path: Path) -> float:
    """The seconds from opening a page to its first ray-marched picture, in a fresh browser."""
    with chromium(SWIFTSHADER) as browser, ExitStack() as stack:
        _, seconds = seconds_of(lambda: stack.enter_context(browser.opened(path, edge=EDGE, until=FIRST)))
    return seconds


def _decoding(page: Path, svoq: Path, rounds: int) -> list[list[float]]:
    """Measure the page's script and Python's reader of the same octree; return their seconds in each round."""
    with chromium(SWIFTSHADER) as browser, browser.opened(page) as tab:
        return in_turn(
            lambda: seconds_of(lambda: tab.ask(DECODE))[1],
            lambda: seconds_of(lambda: io.load(svoq, nerfbake.SparseVoxelOctree))[1],
            rounds=rounds,
        )
