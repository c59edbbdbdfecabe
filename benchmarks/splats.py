"""Benchmark of Gaussian splats: how fast they are read, drawn and made voxels, and what that costs in pictures.

A real scene, biker.spz, is converted to octrees of two resolutions, without and with the fit to pictures of the splats.
The octrees are measured on ten pictures of the splats around the scene, which are not among those that they are fitted
to. The real chair goes the other way: its field becomes splats, which are fitted to pictures of the field or to
photographs, and measured on the held-out photographs. Seconds are CPU seconds of one process, without compilation of
kernels and, for a file of splats, without measuring; those of a fit include its pictures. A scene that is missing keeps
its row and says so.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar

from benchmarks.aims import SPLAT_FILES, SPLAT_OCTREES, SPLAT_PICTURE, SPLAT_READ, Aim, aims_table
from benchmarks.processes import announced
from benchmarks.scenes import Scenes
from nerfbake import SparseVoxelOctree, Splats, build_field, compare_scenes, load, orbit_cameras, render_splats
from nerfbake.bench.environment import environment
from nerfbake.bench.report import Report, Table
from nerfbake.jobs import SplatsOptions, SplatsViews, bake_splats
from nerfbake.jobs.files import Source
from nerfbake.jobs.fit_state import Clock
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.reading_options import EPOCHS, ReadingOptions
from nerfbake.jobs.splat_voxels import sample_splats
from nerfbake.jobs.steps import SILENT
from nerfbake.stages.views_to_error import measure_views

T = TypeVar("T")
FILES = ("biker.spz", "biker.compressed.ply")
RESOLUTIONS = (256, 512)
SPLATS = SplatsOptions()
JUDGES, EDGE, PICTURE = 10, 400, 800

READ = ["file", "splats", "SH", "MB", "read s", "picture s"]
VOXELS = ["voxels", "fitted", "s", "leaves", "PSNR dB, 1 ray", "4 rays"]
BAKED = ["fitted to", "splats", "MB", "s", "PSNR dB"]
NOTES = [
    f"read: of a file in the cache of the operating system. picture: {PICTURE}x{PICTURE}, which frames the scene.",
    f"PSNR: mean over {JUDGES} pictures of {EDGE}x{EDGE}, with one and with 2x2 rays a pixel of the octree. Pictures "
    "of splats blur each splat by about a pixel, so the voxels look best in pictures of that size.",
]


def reports(scenes: Scenes, *, rounds: int = 3) -> dict[str, list[Report] | bytes]:
    """Measure reading and drawing in rounds; a conversion is measured once, after one that compiles the kernels."""
    files: list[list[Any]] = []
    figures: dict[str, float] = {}
    for name in FILES:
        path = scenes.splats / name
        if not path.is_file():
            files.append([f"{name}: not there", *[None] * (len(READ) - 1)])
            continue
        with announced(f"reading and drawing {name}"):
            read, splats = _best(partial(load, path, Splats), rounds)
            camera = orbit_cameras(splats, width=PICTURE, height=PICTURE).cameras[0]
            drawn, _ = _best(partial(render_splats, splats, camera), rounds)
        files.append([name, splats.n, splats.degree, path.stat().st_size / 1e6, read, drawn])
        if name == FILES[0]:
            figures |= {"read: s": read, f"picture of {PICTURE}x{PICTURE}: s": drawn}
    rows = _converted(scenes, figures)
    head = {"scene": "biker, from the PlayCanvas engine's examples (MIT)", **environment("numpy", "numba", "nerfbake")}
    baked = _baked(scenes, figures)
    tables = [
        Table("Files", READ, files),
        Table(f"{FILES[0]} as an octree", VOXELS, rows),
        Table("The chair's field as splats, on its held-out photographs", BAKED, baked),
        aims_table(_aims(figures)),
    ]
    return {"splats": [Report("Splats", head, tables, NOTES)]}


def _converted(scenes: Scenes, figures: dict[str, float]) -> list[list[Any]]:
    """Return the rows of the octrees, and add their figures."""
    path = scenes.splats / FILES[0]
    if not path.is_file():
        return [[f"{FILES[0]}: not there", *[None] * (len(VOXELS) - 1)]]
    splats, rows = load(path, Splats), list[list[Any]]()
    convert = partial(sample_splats, SILENT, Source(str(path)), splats)
    convert(resolution=16)  # compiles the kernels
    for resolution in RESOLUTIONS:
        for epochs in (0, EPOCHS):
            with announced(f"{FILES[0]} in {resolution}^3, {epochs} epochs"):
                work = partial(convert, resolution=resolution, options=ReadingOptions(epochs=epochs))
                seconds, (octree, shown) = _best(work, 1)
                decibels = [_psnr(shown, octree, samples) for samples in (1, 2)]
            leaves, told = int(octree.childless.sum()), [f"{each:.2f}" for each in decibels]
            rows.append([f"{resolution}^3", bool(epochs), seconds, leaves, *told])
            if epochs:
                figures |= {f"{resolution}^3: s": seconds, f"{resolution}^3: PSNR dB": decibels[1]}
    return rows


def _baked(scenes: Scenes, figures: dict[str, float]) -> list[list[Any]]:
    """Return the rows of the splats that are made of a field, and add their figures."""
    rows: list[list[Any]] = []
    for name, views in (("pictures of the field", None), ("photographs", str(scenes.capture))):
        if not (scenes.chair.is_file() and scenes.test_cameras.is_file()):
            rows.append([f"{name}: not there", *[None] * (len(BAKED) - 1)])
            continue
        with announced(f"splats of the chair, fitted to {name}"):
            target = scenes.folder / f"{name}.spz"
            found = bake_splats(scenes.chair, target, SplatsViews(views=views), options=SPLATS)
            held_out = read_photographs(SILENT, Source(str(scenes.capture))).held_out
            errors = measure_views(load(target, Splats).without_up("z"), held_out)
        decibels = sum(each.psnr for each in errors) / len(errors)
        rows.append([name, found.splats, found.bytes / 1e6, found.worked, f"{decibels:.2f}"])
        figures |= {f"{name}: s": found.worked, f"{name}: PSNR dB": decibels, f"{name}: MB": found.bytes / 1e6}
    return rows


def _best(work: Callable[[], T], rounds: int) -> tuple[float, T]:
    """Return the least CPU seconds of the rounds, without compilation, and the last result."""
    seconds = []
    for _ in range(rounds):
        clock = Clock()
        found = work()
        seconds.append(clock.worked)
    return min(seconds), found


def _psnr(splats: Splats, octree: SparseVoxelOctree, samples: int) -> float:
    views = orbit_cameras(splats, frames=JUDGES, width=EDGE, height=EDGE).chosen(samples=samples)
    found = compare_scenes(splats, build_field(octree), views, keep_pictures=False)
    return float(found.means["a_b"]["psnr"])


def _aims(figures: dict[str, float]) -> list[tuple[str, Aim, float | None]]:
    aims = {"read: s": SPLAT_READ, f"picture of {PICTURE}x{PICTURE}: s": SPLAT_PICTURE}
    for resolution, (seconds, decibels) in SPLAT_OCTREES.items():
        aims |= {f"{resolution}^3: s": seconds, f"{resolution}^3: PSNR dB": decibels}
    for name, bounds in SPLAT_FILES.items():
        aims |= {f"{name}: {what}": aim for what, aim in bounds.items()}
    return [(label, aim, figures.get(label)) for label, aim in aims.items()]
