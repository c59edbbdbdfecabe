"""Pages of the real chair at 256^3: their sizes, what baking adds, how soon they show something, and their frames.

The aims are those of a page that is mailed: bytes, seconds of the command beside those of the command that it builds
on, seconds from opening to the first marched picture without a graphics card, the script's decoder by Python's, and
the layout that the shader reads by an octree that is descended from its root. Highlights are those of nerf2mesh's
sample scene, whose MLP is as large as a real one: those of the MLP by those of the atlas baked from it.
"""

from __future__ import annotations

import sys
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import nerfbake
from benchmarks.aims import VIEW, aims_table
from benchmarks.scenes import Scenes
from nerfbake import Cameras, N3Tree, io, load
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics, in_turn, seconds_of
from nerfbake.bench.process import measure_process
from nerfbake.bench.progress import told
from nerfbake.bench.report import Report, Table
from nerfbake.bench.view import surfaces
from nerfbake.bench.view.browser import LLVMPIPE, SWIFTSHADER, chromium
from nerfbake.bench.view.comparison import CHOSEN, COLUMNS, compare_pages

ROUNDS = 3
TEXELS = 512  # along an edge of the sample's textures
EDGE = 400  # pixels
# A second drawing is only begun once the first is there.
FIRST = "nerfbake.frames > 1 || nerfbake.finished"
# Without the pauses that keep a page alive: timers of a page that nobody looks at may take a second each.
DECODE = "(nerfbake.carried.tell = async () => undefined, nerfbake.carried.arrays().then(() => 0))"
RENDERERS = {"SwiftShader": SWIFTSHADER, "llvmpipe": LLVMPIPE}
NOTES = [
    "baking: a whole process of `nerfbake view` less one of `nerfbake compress` or `nerfbake svo`, in the same round.",
    "first picture: from opening the file in a fresh browser to the first drawing that is there, at 400x400, drawn by "
    "SwiftShader. decoding: from the page's text to the shader's arrays, by the script; from the .svoq to the octree, "
    "by Python.",
]


class Made(NamedTuple):
    """The files, and of each round the seconds that a page took more than what it builds on."""

    compressed: Path
    exact: Path
    svoq: Path
    compressing: list[float]
    resampling: list[float]


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        made = _baked(scenes.chair, Path(folder), rounds)
        with told("first pictures"):
            first = [_first_picture(made.compressed) for _ in range(rounds)]
        with told("decoding"):
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
        found = compare_pages(tree, scenes.chair.name, views, rounds=rounds, progress=told, flags=flags, edge=EDGE)
        frames.append(found._replace(title=f"{found.title}, drawn by {name}"))
        figures[f"frames, {name}: x octree"] = _ratio(found, COLUMNS.index("x octree"), CHOSEN)
    stage1 = nerfbake.sample_stage1(resolution=TEXELS)
    for name, flags in RENDERERS.items():
        scene = f"sample of nerf2mesh, {TEXELS}x{TEXELS} texels"
        found = surfaces.compare_surfaces(stage1, scene, rounds=rounds, progress=told, flags=flags, edge=EDGE)
        frames.append(found._replace(title=f"{found.title}, drawn by {name}"))
        ratio = _ratio(found, surfaces.COLUMNS.index("x kmeans"), "mlp_textures")
        figures[f"frames of the MLP, {name}: x atlas"] = ratio
    aims = aims_table([(what, aim, figures.get(what)) for what, aim in VIEW.items()])
    head = {"scene": scenes.chair.name, "rounds": str(rounds), **environment("numpy", "numba", "playwright")}
    return {"view": [Report("Pages to look around in", head, [aims, costs], NOTES), *frames]}


def _ratio(report: Report, column: int, page: str) -> float | None:
    """A page's median, where there is one."""
    found = next(row[column] for row in report.tables[0].rows if row[0] == page)
    return found.median if found else None


def _baked(chair: Path, folder: Path, rounds: int) -> Made:
    """Each page and what it builds on, by whole processes that take turns."""
    files = {name: folder / name for name in ("a.html", "a.svoq", "b.html", "b.svo.npz")}

    def timed(command: str, name: str, *options: str) -> float:
        with told(f"nerfbake {command}: {name}"):
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
    """Seconds from opening a page to its first marched picture, in a browser that has not seen it before."""
    with chromium(SWIFTSHADER) as browser, ExitStack() as stack:
        _, seconds = seconds_of(lambda: stack.enter_context(browser.opened(path, edge=EDGE, until=FIRST)))
    return seconds


def _decoding(page: Path, svoq: Path, rounds: int) -> list[list[float]]:
    """Seconds of each round: the page's script, and Python's reader of the same octree."""
    with chromium(SWIFTSHADER) as browser, browser.opened(page) as tab:
        return in_turn(
            lambda: seconds_of(lambda: tab.ask(DECODE))[1],
            lambda: seconds_of(lambda: io.load(svoq, nerfbake.SparseVoxelOctree))[1],
            rounds=rounds,
        )
