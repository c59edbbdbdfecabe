"""Benchmark of `nerfbake mesh` on the real chair, textured from its 100 photographs.

Each mesh is a whole process, and is measured from the written file on the 25 held-out photographs, with 2x2 rays a
pixel. The CPU seconds are those of the work, without compilation, reading and evaluation; the peak is that of the
process. The folder's atlases are baked, and rendered on the same photographs.

The contender is what exports of nerfstudio and instant-ngp do: marching cubes on a grid of densities at one level, with
the field's plain colours at the vertices and no simplification. Its level is the best of LEVELS on training views.

mesh.svg draws PSNR against megabytes for the meshes of several sizes, and for the contender.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from benchmarks.aims import MESH, aims_table
from benchmarks.processes import announced, measure_process
from benchmarks.scenes import Scenes
from nerfbake import (
    BakedAtlas,
    Mesh,
    Meshes,
    N3Tree,
    SparseVoxelOctree,
    Views,
    build_octree,
    load,
    measure_silhouettes,
    measure_views,
    render_stage1,
    save,
)
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result
from nerfbake.bench.plot import lines
from nerfbake.bench.report import Report, Table
from nerfbake.errors import NerfbakeError
from nerfbake.jobs.files import Source
from nerfbake.jobs.photographs import SplitViews, read_photographs
from nerfbake.jobs.steps import SILENT
from nerfbake.kernels.maths.elementary import sigmoid
from nerfbake.kernels.picture.metrics import psnr
from nerfbake.kernels.surface.cubes import march_cubes
from nerfbake.kernels.surface.samples import CUBE, EDGE, brick_places

SAMPLES = 2  # rays along an edge of a pixel
SH0 = 0.28209479177387814  # the first basis function
LEVELS = (2.5, 10.0, 40.0)  # densities in 1/world unit; the first is instant-ngp's default


class Row(NamedTuple):
    """A mesh. out: the name of its file or folder; options: of `nerfbake mesh`; curve: of mesh.svg, or ''."""

    name: str
    out: str
    options: tuple[str, ...]
    curve: str = ""


SIZES = ("3k", "12k", "50k", "150k")
ROWS = (
    *(Row(f"{size} triangles, .glb", f"{size}.glb", ("--triangles", size), "texture 2048") for size in SIZES),
    *(
        Row(
            f"{size} triangles, 1024, .glb",
            f"{size}_1024.glb",
            ("--triangles", size, "--texture", "1024"),
            "texture 1024",
        )
        for size in ("12k", "50k")
    ),
    Row("50k triangles, .glb, PNG", "png.glb", ("--image", "png")),
    Row("50k triangles, .glb, WebP", "webp.glb", ("--image", "webp")),
    Row("50k triangles, .ply, colours at vertices", "50k.ply", (), "vertex colours"),
    Row("150k triangles, .ply, colours at vertices", "150k.ply", ("--triangles", "150k"), "vertex colours"),
    Row("50k triangles, folder", "stage1", ()),
)
AIMED, FOLDER = ROWS[2], ROWS[-1]
ATLASES = {"64 clusters": ("--clusters", "64"), "affine": ("--method", "affine")}
CONTENDER = "marching cubes, colours at vertices"

COLUMNS = ["mesh", "triangles", "MB", "diffuse dB", "dB", "SSIM", "worst view dB", "IoU", "CPU s", "peak MB"]
BAKED = ["atlas of the folder", "dB", "loss dB"]
NOTES = [
    "dB: the mean PSNR over the 25 held-out photographs, from the written file; with highlights for the folder, whose "
    "diffuse dB is without them. IoU: of the silhouettes. CPU s: without compilation, reading and evaluation; peak: of "
    "the process.",
    f"{CONTENDER}: what nerfstudio's and instant-ngp's exports do, with the best of the levels {LEVELS} on training "
    "views.",
]


def reports(scenes: Scenes, *, rounds: int = 1) -> dict[str, list[Report]]:
    """Measure every row once: a mesh takes minutes, and has the same bytes in every round."""
    if rounds != 1:
        raise ValueError("meshes take minutes, so there is one round")
    split = read_photographs(SILENT, Source(str(scenes.capture)))
    cells: list[list[Any]] = []
    points: list[list[Any]] = []
    figures: dict[str, float] = {}
    for row in ROWS:
        try:
            facts, run = _made(row, scenes)
        except NerfbakeError as error:
            cells.append([f"{row.name}: {error.line}", *[None] * (len(COLUMNS) - 1)])
            continue
        cells.append(_cells(row.name, facts, run.peak))
        points += [[row.curve, facts["bytes"] / 1e6, facts["psnr"]]] * bool(row.curve)
        if row.out == AIMED.out:
            figures |= {"diffuse dB": facts["psnr"], "MB of the .glb": facts["bytes"] / 1e6}
            figures |= {"CPU s": facts["cpu_seconds"], "peak MB": run.peak / 1e6}
        if row.out == FOLDER.out:
            figures |= {"dB": facts["psnr"], "worst view dB": min(view["psnr"] for view in facts["views"])}
    cells.append(plain := _contender(scenes, split))
    points.append([CONTENDER, plain[2], float(plain[3])])
    tables = [
        Table("Meshes of the chair, from the written file", COLUMNS, cells),
        aims_table([(label, aim, figures.get(label)) for label, aim in MESH.items()]),
        Table("Atlases of the folder", BAKED, _atlas_rows(scenes, split.held_out, figures.get("dB"))),
        Table("PSNR by size", ["meshes", "MB", "dB"], points),
    ]
    head = {"rays a pixel": f"{SAMPLES}x{SAMPLES}", **environment("numpy", "numba", "fast-simplification", "nerfbake")}
    return {"mesh": [Report("Meshes", head, tables, NOTES)]}


def chart(report: Report, suffix: str) -> bytes:
    """Draw PSNR against megabytes."""
    curves: dict[str, list[tuple[float, float]]] = {}
    for name, size, decibels in report.tables[-1].rows:
        curves.setdefault(name, []).append((size, decibels))
    return lines(curves, title="The chair's held-out photographs", x="MB", y="PSNR dB", suffix=suffix)


def _made(row: Row, scenes: Scenes) -> tuple[dict[str, Any], Result]:
    words = ["mesh", str(scenes.chair), str(scenes.folder / row.out), "--views", str(scenes.capture), *row.options]
    with announced(f"nerfbake {' '.join(words)}"):
        run = measure_process(sys.executable, "-m", "nerfbake", *words, "--json", "-q", keep=True)
    return json.loads(run.facts["stdout"]), run


def _cells(name: str, facts: dict[str, Any], peak: int) -> list[Any]:
    plain = facts["diffuse"]
    diffuse = facts["psnr"] if plain is None else float(np.mean([view["psnr"] for view in plain]))
    worst = min(view["psnr"] for view in facts["views"])
    told = [f"{diffuse:.2f}", None if plain is None else f"{facts['psnr']:.2f}", f"{facts['ssim']:.4f}", f"{worst:.2f}"]
    size = [sum(facts["triangles"]), facts["bytes"] / 1e6]
    return [name, *size, *told, f"{facts['iou']:.4f}", facts["cpu_seconds"], peak / 1e6]


def _contender(scenes: Scenes, split: SplitViews) -> list[Any]:
    """Plain marching cubes, at the level that is best on some training views."""
    octree = build_octree(load(scenes.chair, N3Tree))
    some = split.training.take(range(0, len(split.training.pictures), 10))
    meshes = [Meshes((marched(octree, level),)) for level in LEVELS]
    best = max(meshes, key=lambda mesh: float(np.mean([each.psnr for each in measure_views(mesh, some)])))
    size = save(scenes.folder / "contender.ply", best, force=True)
    views = measure_views(best, split.held_out, samples=SAMPLES)
    figures = [float(np.mean([getattr(each, name) for each in views])) for name in ("psnr", "ssim")]
    told = [f"{figures[0]:.2f}", None, f"{figures[1]:.4f}", f"{min(each.psnr for each in views):.2f}"]
    iou = float(np.mean(measure_silhouettes(best, split.held_out)))
    return [CONTENDER, len(best.meshes[0].faces), size / 1e6, *told, f"{iou:.4f}", None, None]


def marched(octree: SparseVoxelOctree, level: float) -> Mesh:
    """Marching cubes on the densities at all voxel centres, with the colours that the field has from no direction."""
    x, y, z = (-(-count // EDGE) for count in octree.size)
    values = np.empty((x, y, z, CUBE), np.float32)
    for i in range(x):  # all values of all voxels do not fit into memory
        ends = np.arange(EDGE * i, EDGE * (i + 1)), np.arange(EDGE * y), np.arange(EDGE * z)
        centres = octree.origin + (np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1) + 0.5) * octree.voxel_size
        slab = octree.sample(centres)[..., -1].reshape(EDGE, y, EDGE, z, EDGE)
        values[i] = -slab.transpose(1, 3, 0, 2, 4).reshape(y, z, CUBE)
    top = np.arange(x * y * z, dtype=np.int32).reshape(x, y, z)
    positions, faces = march_cubes(top, brick_places(top), values.reshape(-1, CUBE), -level)
    places = octree.origin + (positions + 0.5) * octree.voxel_size
    found = octree.sample(places, lookup="trilinear")
    B = found.shape[-1] // 3
    colours = sigmoid(SH0 * found[:, 0 : 3 * B : B].astype(np.float64))
    return Mesh(places.astype(np.float32), None, faces.astype(np.uint32), colours=colours.astype(np.float32))


def _atlas_rows(scenes: Scenes, held_out: Views, whole: float | None) -> list[list[Any]]:
    """Bake the folder's atlases, and measure them on the held-out photographs."""
    rows: list[list[Any]] = []
    for name, options in ATLASES.items():
        folder = scenes.folder / f"atlas_{options[-1]}"
        words = ["atlas", str(scenes.folder / FOLDER.out), str(folder), *options]
        try:
            with announced(f"nerfbake {' '.join(words)}"):
                measure_process(sys.executable, "-m", "nerfbake", *words, "-q")
        except NerfbakeError as error:
            rows.append([f"{name}: {error.line}", None, None])
            continue
        decibels = _measured(folder, held_out)
        rows.append([name, f"{decibels:.2f}", None if whole is None else f"{whole - decibels:.2f}"])
    return rows


def _measured(folder: Path, held_out: Views) -> float:
    baked, found = load(folder, BakedAtlas), []
    for number, camera in enumerate(held_out.cameras.cameras):
        made = render_stage1(baked, camera, background=held_out.background, samples=SAMPLES).colour
        found.append(psnr(made.astype(np.float64), held_out.photograph(number).astype(np.float64)))
    return float(np.mean(found))
