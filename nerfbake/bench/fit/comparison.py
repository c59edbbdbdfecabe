"""`nerfbake fit` on one's own photographs: PSNR over time, what the field costs in each structure, and what rays ask.

Each fit is a whole process, as somebody types it; its seconds are CPU seconds without compiling and judging, halved: as
long as two cores take. The last of the fits is then written in every structure.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import nerfbake
from nerfbake import io
from nerfbake.bench.access.rays import RAY_NOTES, ray_rows, ray_table
from nerfbake.bench.environment import environment
from nerfbake.bench.fit.published import MERGING, PAPER
from nerfbake.bench.fit.structures import COLUMNS, FRAMES, NOTES, Judges, structure_rows
from nerfbake.bench.plot import lines
from nerfbake.bench.process import measure_process
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.scene.camera import Cameras
from nerfbake.scene.views import Views

COURSES = ("fast", "balanced", "best")  # presets; a number stands for minutes
_OVER_TIME = "PSNR over time"
CURVE = ["fit", "s", "lattice", "cells", "PSNR dB", "of"]
FITS = ["fit", "s", "PSNR dB", "SSIM", "cells", "MB", "peak MB", "schedule"]
FIT_NOTES = [
    "s: CPU seconds / 2, without compiling kernels and without judging. peak: of the whole process.",
    "PSNR and SSIM: from the written file by the reference renderer, means over the views that judge; in the curve "
    "over a handful of them.",
]


class Fit(NamedTuple):
    """One fit: its preset or minutes, what `nerfbake fit --json` tells, and the most bytes that its process held."""

    course: str
    facts: dict[str, Any]
    peak: int


def compare_fits(
    source: str,
    views: Views,
    *,
    courses: Sequence[str] = COURSES,
    samples: int = 2,
    resolution: int = 256,
    rounds: int,
    progress: Progress,
) -> Report:
    """Fits `source` in each course, a preset or minutes, and reports. views: those that fit itself keeps for judging.
    rounds: how often frames are timed. Raises NerfbakeError where a fit fails.
    """
    with TemporaryDirectory(prefix="nerfbake-bench-") as name:
        folder = Path(name)
        fits = []
        for course in courses:
            with progress(f"fitting, {' '.join(_choice(course))}"):
                fits.append(fitted(source, folder, course, samples, resolution))
        last = Path(fits[-1].facts["file"])
        judges = Judges(views, samples, _timed(views, folder))
        structures = structure_rows(last, judges, folder, rounds=rounds, progress=progress)
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
        Table(_OVER_TIME, CURVE, [row for fit in fits for row in _curve_rows(fit)]),
        PAPER,
        Table(f"Structures of the fit `{fits[-1].course}` (PlenVDB's table 4 for this scene)", COLUMNS, structures),
        MERGING,
        ray_table(rays, " (PlenVDB's table 1 for this scene)"),
    ]
    return Report(f"Fitting: {Path(source).name}", head, tables, FIT_NOTES + NOTES + RAY_NOTES)


def chart_fits(report: Report, suffix: str) -> bytes:
    """PSNR over seconds, a curve for each fit, which ends with its written file."""
    (rows,) = (table.rows for table in report.tables if table.title == _OVER_TIME)
    names = dict.fromkeys(row[0] for row in rows)
    curves = {name: [(row[1], float(row[4])) for row in rows if row[0] == name] for name in names}
    return lines(curves, title=report.title, x="CPU seconds / 2", y="PSNR dB", suffix=suffix)


def fitted(source: str, folder: Path, course: str, samples: int, resolution: int) -> Fit:
    """One fit, a process of its own, whose file goes to the folder. Raises NerfbakeError with its last words."""
    command = [sys.executable, "-m", "nerfbake", "fit", source, str(folder / f"{course}.npz"), *_choice(course)]
    command += ["--samples", str(samples), "--resolution", str(resolution), "--json", "-q"]
    found = measure_process(*command, keep=True)
    return Fit(course, json.loads(found.facts["stdout"]), found.peak)


def _choice(course: str) -> list[str]:
    return ["--preset", course] if course in COURSES else ["--minutes", course]


def _fit_row(fit: Fit) -> list[Any]:
    facts = fit.facts
    cells = facts["curve"][-1]["cells"] if facts["curve"] else None
    shown = [f"{facts['psnr']:.2f}", f"{facts['ssim']:.4f}", cells, facts["bytes"] / 1e6]
    return [fit.course, facts["cpu_seconds"] / 2, *shown, fit.peak / 1e6, facts["epochs"]]


def _curve_rows(fit: Fit) -> list[list[Any]]:
    """The points that the fit tells, and the written file as the last one."""
    points = [(point["seconds"], point["resolution"], point["cells"], point["psnr"]) for point in fit.facts["curve"]]
    last = points[-1][1:3] if points else (None, None)
    points.append((fit.facts["cpu_seconds"], *last, fit.facts["psnr"]))
    of = ["a handful"] * (len(points) - 1) + ["the written file"]
    return [
        [fit.course, seconds / 2, *size, f"{psnr:.2f}", what]
        for (seconds, *size, psnr), what in zip(points, of, strict=True)
    ]


def _timed(views: Views, folder: Path) -> str:
    """The file of the cameras whose frames are timed."""
    path = folder / "timed.json"
    cameras = views.cameras.cameras
    io.save(path, Cameras(cameras[:: max(1, len(cameras) // FRAMES)][:FRAMES]))
    return str(path)
