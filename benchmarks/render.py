"""Benchmark of rendering: frame times of every structure that nerfbake writes, from the written file.

The scenes are the real chair at 256^3 and 128^3, in its five held-out views. Each row is a separate process: it reads
its file, renders a warm-up picture, then one picture from each camera. PSNR is measured against the pictures of the
PlenOctree (or of the octree, if the scene is one). The aims are the time of a frame, and of a process that renders one
picture.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np

import nerfbake
from benchmarks.aims import FIRST_PICTURE, FRAME, aims_table
from benchmarks.processes import announced, in_turn, measure_process
from benchmarks.scenes import Scenes
from nerfbake import io, load
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Progress, Result, Statistics, Work, measure, seconds_of
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.report import Report, Table
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import Cameras
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree

EDGES = (400, 800)
LOOKUPS = ("nearest", "trilinear")
FRAMES = 8  # around the scene
COLUMNS = ["structure", "pixels", "lookup", "ms a frame", "frames a second", "ready s", "cells MB"]
COLUMNS += ["file MB", "PSNR dB"]
NOTES = [
    "ms a frame: median [min..max] over rounds, each the mean of all cameras' pictures, after a warm-up picture.",
    "ready: from the scene in memory to the first picture, including building its table of cells and loading compiled "
    "code. cells: the size of the table and its values.",
    "PSNR: against the first row's pictures of that size with nearest lookup; 100 for equal pictures. Trilinear lookup "
    "smooths values that were optimised as cells.",
    "All rows use the same ray marcher: each structure is converted to a table of cells.",
    "As context: PlenOctrees (Yu et al., 2021) report more than 150 frames a second at 800x800, in CUDA on a GPU.",
]


class SceneFile(NamedTuple):
    """The file of the scene in one structure."""

    name: str
    path: str


def compare_rendering(
    scene: N3Tree | SparseVoxelOctree, name: str, cameras: Cameras | None, *, rounds: int, progress: Progress
) -> Report:
    """Write the scene in every structure, render each, and return the report. cameras: by default an orbit."""
    results: dict[tuple[SceneFile, int, str], list[Result]] = {}
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        with progress("writing the structures"):
            rows = _written(scene, Path(folder))
            views = cameras or nerfbake.orbit_cameras(nerfbake.build_field(scene), frames=FRAMES)
            shown = str(Path(folder) / "cameras.json")
            io.save(shown, views)
        for edge in EDGES:
            truth = str(Path(folder) / f"truth_{edge}.npy")
            for _ in range(rounds):
                for lookup in LOOKUPS:
                    for row in rows:
                        with progress(f"{row.name}, {edge}x{edge}, {lookup}"):
                            arguments = {"path": row.path, "cameras": shown, "edge": edge, "truth": truth}
                            found = measure(rendering, lookup=lookup, **arguments)
                        results.setdefault((row, edge, lookup), []).append(found)
        sizes = {row.path: Path(row.path).stat().st_size for row in rows}
        with progress("a process of its own"):
            (first,) = in_turn(lambda: _first_picture(rows[0], shown), rounds=rounds)
    head = {
        "scene": f"{name}: {scene}",
        "cameras": str(len(views.cameras)),
        "rounds": str(rounds),
        **environment("numpy", "numba"),
    }
    figures = Table("Rendering", COLUMNS, [_cells(key, found, sizes) for key, found in results.items()])
    whole = Table(
        "`nerfbake render` as a process, 400x400: import, read, render, write; compiled code is on the disk",
        ["scene", "s"],
        [[rows[0].name, Statistics.of(first)]],
    )
    return Report(f"Rendering: {name}", head, [figures, whole], NOTES)


def chart_rendering(report: Report, suffix: str) -> bytes:
    """Plot time against memory, with a point for each measured row."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    marks = [
        Mark(f"{row['structure']} {row['pixels']}", row["cells MB"], row["ms a frame"].median, row["lookup"])
        for row in rows
        if row["ms a frame"] is not None
    ]
    return scatter(marks, title=report.title, x="cells in memory, MB", y="ms a frame (median)", suffix=suffix)


def rendering(path: str, cameras: str, edge: int, lookup: Any, truth: str) -> Work:
    """The work of rendering a picture from each camera; called in a child process."""
    with memory_limit(1 << 46):
        scene: Any = io.load(path)
    views = [camera.resized(edge, edge) for camera in io.load(cameras, nerfbake.Cameras).cameras]

    def run() -> list[Any]:
        return [nerfbake.render_field(field, view, lookup=lookup) for view in views]

    def prepare() -> nerfbake.RadianceField:
        made = nerfbake.build_field(scene)
        nerfbake.render_field(made, views[0].resized(8, 8), lookup=lookup)
        return made

    field, ready = seconds_of(prepare)
    nerfbake.render_field(field, views[0], lookup=lookup)  # warms up memory and caches

    def check(images: list[Any]) -> dict[str, Any]:
        seen = np.stack([image.colour for image in images])
        if not Path(truth).exists():
            np.save(truth, seen)
        errors = [psnr(a, b) for a, b in zip(seen.astype(np.float64), np.load(truth), strict=True)]
        size = field.cells.slots.nbytes + field.values.nbytes
        return {"frames": len(images), "psnr": float(np.mean(errors)), "ready": ready, "cells": size}

    return Work(run, check)


def _written(scene: N3Tree | SparseVoxelOctree, folder: Path) -> list[SceneFile]:
    octree = nerfbake.build_octree(scene) if isinstance(scene, N3Tree) else scene
    sh = octree.data_format.startswith("SH")
    made: list[tuple[str, str, Any, dict[str, Any]]] = []
    if isinstance(scene, N3Tree):
        made.append(("N3Tree", "tree.npz", scene, {}))
    made.append(("octree", "octree.svo.npz", octree, {}))
    if sh:
        made.append(("VDB, density and sh", "grids.vdb", nerfbake.build_vdb(octree, grids=("density", "sh")), {}))
    made.append(("VDB index, float16", "index.nvdb", nerfbake.build_vdb(octree, grids=("index",), half=True), {}))
    for _, name, thing, options in made:
        io.save(folder / name, thing, **options)
    return [SceneFile(label, str(folder / name)) for label, name, _, _ in made]


def _first_picture(row: SceneFile, cameras: str) -> float:
    """The seconds of a whole process that renders one picture."""
    command = [sys.executable, "-m", "nerfbake", "render", row.path, "--cameras", cameras, "--size", "400x400"]
    return measure_process(*command, "--out", "-", "-q").seconds


def _cells(key: tuple[SceneFile, int, str], found: list[Result], sizes: dict[str, int]) -> list[Any]:
    row, edge, lookup = key
    if error := next((result.error for result in found if result.error), ""):
        return [f"{row.name}: {error}", f"{edge}x{edge}", lookup, *[None] * (len(COLUMNS) - 3)]
    frame, ready = (
        Statistics.of([1e3 * result.seconds / result.facts["frames"] for result in found]),
        Statistics.of([result.facts["ready"] for result in found]),
    )
    facts = [ready, found[0].facts["cells"] / 1e6, sizes[row.path] / 1e6, found[0].facts["psnr"]]
    return [row.name, f"{edge}x{edge}", lookup, frame, 1e3 / frame.median, *facts]


ROUNDS = 3

chart = chart_rendering


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    cameras = load(scenes.views / "transforms.json", Cameras)
    found = []
    for name in FRAME:
        report = compare_rendering(load(scenes.chairs / name, N3Tree), name, cameras, rounds=rounds, progress=announced)
        found.append(report._replace(tables=[*report.tables, _aims(report, name)]))
    return {"render": found}


def _aims(report: Report, name: str) -> Table:
    frames, processes = report.tables
    frame = dict(zip(COLUMNS, frames.rows[0], strict=True))["ms a frame"].median
    return aims_table(
        [
            (f"{name}, PlenOctree, 400x400, nearest: ms a frame", FRAME[name], frame),
            (f"{name}: first picture of a process, s", FIRST_PICTURE, processes.rows[0][1].median),
        ]
    )
