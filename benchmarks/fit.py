"""Benchmark of `nerfbake fit` and `nerfbake refit` on the real chair.

The report has PSNR over time for each fit, with 2x2 rays a pixel and with one. Each fit is a whole process. Its seconds
are half of its CPU seconds without compilation and evaluation, that is, the time on two cores. The last fit is then
written in every structure of PlenVDB's table 4, with file size, PSNR and frame time, and the samples along its rays are
counted. Finally, the chair's octree at 128^3 is refitted. The aims are PSNR and time of the fits, their memory, and the
gain of refitting.

The published figures for comparison are PlenVDB's tables 2 and 4 (docs/sources.md): one V100, pictures of 800x800, the
eight scenes of NeRF-Synthetic. The benchmark `papers` fits such pictures.
"""

from __future__ import annotations

import json
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import nerfbake
from benchmarks.aims import FIT, FIT_MEMORY, FIT_ONE_RAY, REFIT, Aim, aims_table
from benchmarks.processes import announced, measure_process
from benchmarks.render import rendering
from benchmarks.scenes import Scenes
from nerfbake import build_octree, io, load, save
from nerfbake.bench.access.rays import RAY_NOTES, ray_rows, ray_table
from nerfbake.bench.environment import environment
from nerfbake.bench.fit.published import plenvdb_table
from nerfbake.bench.measure import Progress, Statistics, measure
from nerfbake.bench.plot import lines
from nerfbake.bench.report import Report, Table
from nerfbake.errors import NerfbakeError
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.scene.camera import Cameras
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.views import Views

MERGING = Table(
    "PlenVDB, table 4, as context: chair at 160^3, on a V100",
    ["structure", "MB", "frames a second"],
    [
        ["as DVGO", None, 3],
        ["two VDBs, valid samples only", 108, 22],
        ["merged", 39, 30],
        ["merged, float16", 19, None],
    ],
)


EDGE = 400  # pixels of the frames that are timed, one ray each
FRAMES = 4  # held-out cameras whose frames are timed
COLUMNS = ["structure", "R", "MB", "PSNR dB", "change dB", "ms a frame", "frames a second"]
NOTES = [
    "Grids of their own: a tree for the density and for the coefficients of each basis function, as in OpenVDB. "
    "Merged: one tree of indices, and a table with all values of a voxel. Compressed: NanoVDB's zip.",
    "R: first the finest lattice, where nothing is lost and a coarse cell is eight voxels; then the lattice of the "
    "coarse cells, where split cells are averaged. change: difference of the PSNR to that of the file from fit.",
    f"ms a frame: {EDGE}x{EDGE}, one ray a pixel, from the written file; median [min..max] over rounds.",
]


class Structure(NamedTuple):
    """A way to write the voxels; grids and half: options of build_vdb()."""

    name: str
    ending: str
    grids: tuple[str, ...]
    half: bool = False
    codec: str = "none"


STRUCTURES = (
    Structure("grids of their own", ".vdb", ("density", "sh")),
    Structure("merged", ".nvdb", ("index",)),
    Structure("merged, float16", ".nvdb", ("index",), half=True),
    Structure("merged, float16, compressed", ".nvdb", ("index",), half=True, codec="zip"),
)


class HeldOutViews(NamedTuple):
    """views: the held-out views, rendered with samples x samples rays a pixel. cameras: the file of timed cameras."""

    views: Views
    samples: int
    cameras: str

    def psnr(self, path: Path) -> float:
        """The PSNR of a written scene in dB, mean over the views."""
        errors = nerfbake.measure_views(nerfbake.build_field(io.load(path)), self.views, samples=self.samples)
        return sum(error.psnr for error in errors) / len(errors)


def structure_rows(
    fitted: Path, held_out: HeldOutViews, folder: Path, *, rounds: int, progress: Progress
) -> list[list[Any]]:
    """Return a row for each structure and resolution of a PlenOctree from fit, or a row with the error."""
    with progress(f"judging {fitted.name}"):
        octree = nerfbake.build_octree(io.load(fitted, nerfbake.N3Tree))
        edge, own = max(octree.size), held_out.psnr(fitted)
        rows = [["PlenOctree, as fit wrote it", edge, *_figures(fitted, fitted.stat().st_size, own, held_out, rounds)]]
    coarse = nerfbake.cut_octree(octree, level=octree.grid_level - 1)
    for tree in (octree, coarse):
        for structure in STRUCTURES:
            path, edge = folder / f"structure{structure.ending}", max(tree.size)
            with progress(f"{structure.name}, R = {edge}"):
                try:
                    size = _written(structure, tree, path)
                    rows.append([structure.name, edge, *_figures(path, size, own, held_out, rounds)])
                except NerfbakeError as error:
                    rows.append([f"{structure.name}: {error.line}", edge, *[None] * (len(COLUMNS) - 2)])
    return rows


def _written(structure: Structure, octree: SparseVoxelOctree, path: Path) -> int:
    """Write the octree in a structure, and return the size of the file in bytes."""
    volume = nerfbake.build_vdb(octree, grids=structure.grids, half=structure.half)
    return io.save(path, volume, force=True, codec=structure.codec)


def _figures(path: Path, size: int, own: float, held_out: HeldOutViews, rounds: int) -> list[Any]:
    """Return the cells after the resolution; own: the PSNR in dB of the file from fit."""
    seen = held_out.psnr(path)
    return [size / 1e6, f"{seen:.2f}", f"{seen - own:.2f}", *_frames(path, held_out, rounds)]


def _frames(path: Path, held_out: HeldOutViews, rounds: int) -> list[Any]:
    """Measure milliseconds a frame and frames a second in a separate process."""
    arguments = {"path": str(path), "cameras": held_out.cameras, "edge": EDGE, "lookup": "nearest"}
    found = [measure(rendering, truth=f"{path}.frames.npy", **arguments) for _ in range(rounds)]
    if found[0].error:
        return [found[0].error, None]
    frame = Statistics.of([1e3 * result.seconds / result.facts["frames"] for result in found])
    return [frame, 1e3 / frame.median]


PRESETS = ("fast", "balanced", "best")  # presets; a schedule can also be a number of minutes
OVER_TIME = "PSNR over time"
CURVE = ["fit", "s", "lattice", "cells", "PSNR dB", "of"]
FITS = ["fit", "s", "PSNR dB", "SSIM", "cells", "MB", "peak MB", "schedule"]
FIT_NOTES = [
    "s: CPU seconds / 2, without compilation of kernels and without evaluation. peak: of the whole process.",
    "PSNR and SSIM: from the written file with the reference renderer, means over the held-out views; in the curve "
    "over a handful of them.",
]


class Fit(NamedTuple):
    """A fit: its preset, minutes or name, the output of `nerfbake fit --json`, and the peak memory of its process."""

    schedule: str
    facts: dict[str, Any]
    peak: int


def compare_fits(
    source: str,
    views: Views,
    *,
    schedules: Sequence[str] = PRESETS,
    samples: int = 2,
    resolution: int = 256,
    rounds: int,
    progress: Progress,
) -> Report:
    """Fit `source` in each schedule, a preset or minutes, and return the report.

    views: the views that fit holds out. rounds: how often frames are timed. Raises NerfbakeError if a fit fails.
    """
    with TemporaryDirectory(prefix="nerfbake-bench-") as name:
        folder = Path(name)
        fits = []
        for schedule in schedules:
            with progress(f"fitting, {' '.join(_choice(schedule))}"):
                fits.append(fitted(source, folder, schedule, samples, resolution))
        last = Path(fits[-1].facts["file"])
        held_out = HeldOutViews(views, samples, _timed(views, folder))
        structures = structure_rows(last, held_out, folder, rounds=rounds, progress=progress)
        octree = nerfbake.build_octree(io.load(last, nerfbake.N3Tree))
        density = nerfbake.build_vdb(octree, grids=("density",))
        rays = ray_rows(max(octree.size), density, views.cameras.cameras, progress)
    head = {
        "source": f"{Path(source).name}, judged by {views}",
        "rays a pixel": f"{samples}x{samples}",
        "resolution": str(resolution),
        "rounds": str(rounds),
        **environment("numpy", "numba", "nerfbake"),
    }
    tables = [
        Table("Fits, from the written file", FITS, [_fit_row(fit) for fit in fits]),
        Table(OVER_TIME, CURVE, [row for fit in fits for row in curve_rows(fit)]),
        plenvdb_table(),
        Table(f"Structures of the fit `{fits[-1].schedule}` (PlenVDB's table 4 for this scene)", COLUMNS, structures),
        MERGING,
        ray_table(rays, " (PlenVDB's table 1 for this scene)"),
    ]
    return Report(f"Fitting: {Path(source).name}", head, tables, FIT_NOTES + NOTES + RAY_NOTES)


def chart_fits(report: Report, suffix: str) -> bytes:
    """Plot PSNR over seconds, with a curve for each fit that ends with its written file."""
    (rows,) = (table.rows for table in report.tables if table.title == OVER_TIME)
    names = dict.fromkeys(row[0] for row in rows)
    curves = {name: [(row[1], float(row[4])) for row in rows if row[0] == name] for name in names}
    return lines(curves, title=report.title, x="CPU seconds / 2", y="PSNR dB", suffix=suffix)


def fitted(source: str, folder: Path, schedule: str, samples: int, resolution: int) -> Fit:
    """Run a fit in a separate process, with its file in the folder. Raises NerfbakeError with its last line."""
    command = [sys.executable, "-m", "nerfbake", "fit", source, str(folder / f"{schedule}.npz"), *_choice(schedule)]
    command += ["--samples", str(samples), "--resolution", str(resolution), "--json", "-q"]
    found = measure_process(*command, keep=True)
    return Fit(schedule, json.loads(found.facts["stdout"]), found.peak)


def _choice(schedule: str) -> list[str]:
    return ["--preset", schedule] if schedule in PRESETS else ["--minutes", schedule]


def _fit_row(fit: Fit) -> list[Any]:
    facts = fit.facts
    cells = facts["curve"][-1]["cells"] if facts["curve"] else None
    shown = [f"{facts['psnr']:.2f}", f"{facts['ssim']:.4f}", cells, facts["bytes"] / 1e6]
    return [fit.schedule, facts["cpu_seconds"] / 2, *shown, fit.peak / 1e6, facts["epochs"]]


def curve_rows(fit: Fit) -> list[list[Any]]:
    """Return the points of the fit's curve, and the written file as the last point."""
    points = [(point["seconds"], point["resolution"], point["cells"], point["psnr"]) for point in fit.facts["curve"]]
    last = points[-1][1:3] if points else (None, None)
    points.append((fit.facts["cpu_seconds"], *last, fit.facts["psnr"]))
    of = ["a handful"] * (len(points) - 1) + ["the written file"]
    return [
        [fit.schedule, seconds / 2, *size, f"{psnr:.2f}", what]
        for (seconds, *size, psnr), what in zip(points, of, strict=True)
    ]


def _timed(views: Views, folder: Path) -> str:
    """Write the file of the cameras whose frames are timed."""
    path = folder / "timed.json"
    cameras = views.cameras.cameras
    io.save(path, Cameras(cameras[:: max(1, len(cameras) // FRAMES)][:FRAMES]))
    return str(path)


ROUNDS = 2
RESOLUTION = 256
COARSE = 128  # voxels an axis of the refitted octree
LIKE: tuple[str, ...] = ()  # options of `refit --like`: the defaults
REFITS = ["to look like", "rays a pixel", "PSNR dB before", "PSNR dB", "gain dB", "s"]

chart = chart_fits


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    source = str(scenes.capture)
    views = read_photographs(SILENT, Source(source)).held_out
    options: dict[str, Any] = {"resolution": RESOLUTION, "rounds": rounds, "progress": announced}
    report = compare_fits(source, views, schedules=tuple(FIT), **options)
    single = compare_fits(source, views, schedules=("balanced",), samples=1, **options)
    refits = Table(f"`nerfbake refit` of {scenes.chair.name} at {COARSE}^3", REFITS, _refit_rows(scenes))
    fits, *others = report.tables
    tables = [fits, _aims(fits, single.tables[0], refits), *others, refits]
    return {"fit": [report._replace(tables=tables), single]}


def _refit_rows(scenes: Scenes) -> list[list[Any]]:
    rows: list[list[Any]] = []
    with tempfile.TemporaryDirectory() as name:
        coarse = Path(name) / "coarse.svo.npz"
        save(coarse, build_octree(load(scenes.chair, N3Tree), resolution=COARSE))
        models = {
            "its photographs": ("--views", str(scenes.capture)),
            "the PlenOctree": ("--like", str(scenes.chair), *LIKE),
        }
        for what, model in models.items():
            for samples in (1, 2):
                target = str(Path(name) / f"{samples}.svo.npz")
                command = [sys.executable, "-m", "nerfbake", "refit", str(coarse), target, *model, "--json", "-q"]
                with announced(f"refitting to {what}, {samples}x{samples} rays a pixel"):
                    run = measure_process(*command, "--samples", str(samples), "--force", keep=True)
                facts = json.loads(run.facts["stdout"])
                before, after = facts["psnr_before"], facts["psnr"]
                shown = [f"{each:.2f}" for each in (before, after, after - before)]
                rows.append([what, f"{samples}x{samples}", *shown, facts["cpu_seconds"] / 2])
    return rows


def _aims(fits: Table, single: Table, refits: Table) -> Table:
    rows: list[tuple[str, Aim, float | None]] = []
    for table, aims, rays in ((fits, FIT, "2x2 rays"), (single, {"balanced": FIT_ONE_RAY}, "one ray")):
        for row in table.rows:
            fit = dict(zip(FITS, row, strict=True))
            seconds, decibels = aims[fit["fit"]]
            rows.append((f"{fit['fit']}, {rays} a pixel: s", seconds, fit["s"]))
            rows.append((f"{fit['fit']}, {rays} a pixel: PSNR dB", decibels, float(fit["PSNR dB"])))
            rows.append((f"{fit['fit']}, {rays} a pixel: MB of the process", FIT_MEMORY, fit["peak MB"]))
    gains = [(f"refit to {row[0]}, {row[1]} rays a pixel: dB gained", REFIT, float(row[4])) for row in refits.rows]
    return aims_table([*rows, *gains])
