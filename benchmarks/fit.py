"""`nerfbake bench fit` on the real chair, with 2x2 rays a pixel and with one; `nerfbake refit` of its octree at 128^3.

The aims are what the fits reach, and by when; the memory that they take; and what refitting gains.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

from benchmarks.aims import FIT, FIT_MEMORY, FIT_ONE_RAY, REFIT, Aim, aims_table
from benchmarks.scenes import Scenes
from nerfbake import build_octree, load, save
from nerfbake.bench.fit.comparison import FITS, chart_fits, compare_fits
from nerfbake.bench.process import measure_process
from nerfbake.bench.progress import told
from nerfbake.bench.report import Report, Table
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.scene.n3tree import N3Tree

ROUNDS = 2
RESOLUTION = 256
COARSE = 128  # voxels an axis of the octree that is refitted
LIKE: tuple[str, ...] = ()  # options of what it is refitted to look like: the defaults
REFITS = ["to look like", "rays a pixel", "PSNR dB before", "PSNR dB", "gain dB", "s"]

chart = chart_fits


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    source = str(scenes.capture)
    views = read_photographs(SILENT, Source(source)).judges
    options: dict[str, Any] = {"resolution": RESOLUTION, "rounds": rounds, "progress": told}
    report = compare_fits(source, views, courses=tuple(FIT), **options)
    single = compare_fits(source, views, courses=("balanced",), samples=1, **options)
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
                with told(f"refitting to {what}, {samples}x{samples} rays a pixel"):
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
