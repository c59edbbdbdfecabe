"""Benchmark of trilinear reads of one scene in every structure (`bench access`): time, memory and file sizes.

It repeats PlenVDB's tables 1 and 3 on the current machine. Each figure comes from a separate process that has read all
points once before the clock starts. The rows take turns, round by round, and every row reads on one thread. A second
table has the size of every possible file of the scene at each resolution.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nerfbake import io, memory
from nerfbake.bench.access.rays import RAY_NOTES, ray_rows, ray_table
from nerfbake.bench.access.readers import READERS, Reader, reading, write_inputs
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Progress, Result, Statistics, measure
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.report import Report, Table
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError, UsageError
from nerfbake.scene.camera import Camera
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import Volume
from nerfbake.stages.n3tree_to_octree import build_octree
from nerfbake.stages.octree_to_vdb import build_vdb

FILE_COLUMNS = ["file", "R", "MB"]


def file_rows(folder: Path, R: int, tree: SparseVoxelOctree, density: Volume, index: Volume) -> list[list[Any]]:
    """Return the size of each file, or the reason why it could not be written.

    Formats have limits, and some scenes exceed the range of float16.
    """
    path = folder / "file"

    def row(what: str, scene: Any, to: str, **options: Any) -> list[Any]:
        try:
            return [what, R, io.save(path, scene, to=to, force=True, **options) / 1e6]
        except NerfbakeError as error:
            return [f"{what}: {error.line.removeprefix(f'{path}: ')}", R, None]

    rows = [row(f"octree .{to}", tree, to) for to in ("svo.npz", "svo.pb")]
    for what, volume, endings in (("density", density, ("nvdb", "vdb")), ("index", index, ("nvdb",))):
        try:
            half = build_vdb(tree, grids=(what,), half=True)
        except InvalidScene as error:
            rows.append([f"{what} half: {error.line}", R, None])
            half = None
        for to, codec in product(endings, ("none", "zip")):
            packed = " zip" if codec == "zip" else ""
            rows.append(row(f"{what} .{to}{packed}", volume, to, codec=codec))
            if half:
                rows.append(row(f"{what} .{to} half{packed}", half, to, codec=codec))
    return rows


PACKAGES = ("numpy", "numba", "warp-lang")
RESOLUTIONS = (128, 320, 512)
POINTS = 1_000_000
AGREE = 1e-5  # tolerance, relative to the sum of absolute values
REFERENCE = "VDB index"
KINDS = ("diagonal", "random", "rays", "surface")
COLUMNS = ["structure", "R", "channels", *(f"{kind} ns" for kind in KINDS), "surface x NanoVDB", "MB", "sums agree"]
NOTES = [
    "ns: one trilinear read of float32 values on one thread, after a warm-up pass: median [min..max].",
    "diagonal: PlenVDB's 800 samples from corner to corner, repeated; random: anywhere in the grid; rays: along "
    "camera rays in steps of half a voxel; surface: anywhere in randomly chosen active voxels. A million of each.",
    "Points are float32 values in every row; NanoVDB and Warp read them as float32, all others as float64.",
    "x NanoVDB: ratio of the median to the faster of NanoVDB's two rows at the same R, one channel.",
    "MB: the arrays that are read (NanoVDB, Warp: the grid). VDB stores dense leaves, VDB index reads masks.",
    "sums agree: the sums of all values read match those of VDB index to 1e-5 of the sum of absolute values.",
    "dense pointers: Plenoxels' grid of int32 links. octree: a descent from the root for each of 8 corners; beyond the "
    "PlenOctree's own resolution its leaves stay large.",
]


def compare_access(
    scene: N3Tree | SparseVoxelOctree,
    name: str,
    *,
    resolutions: Sequence[int] | None,
    rounds: int,
    progress: Progress,
    cameras: Sequence[Camera] = (),
    points: int = POINTS,
) -> Report:
    """Measure every row at every resolution and return the report; progress(text) surrounds each step.

    An octree has a single resolution. Raises UsageError if `resolutions` is set for an octree, InvalidScene for a scene
    without a voxel. A structure beyond the memory limit becomes a row with the error.
    """
    if isinstance(scene, SparseVoxelOctree) and resolutions:
        raise UsageError("an octree has its own resolution; allowed: --resolution with a PlenOctree")
    reads, sizes, rays = [], [], []
    version = ""
    for R in resolutions or (RESOLUTIONS if isinstance(scene, N3Tree) else (max(scene.size),)):
        try:
            with progress(f"R = {R}: building"):
                tree = build_octree(scene, resolution=R) if isinstance(scene, N3Tree) else scene
                density, index = (build_vdb(tree, grids=(g,)) for g in ("density", "index"))
        except MemoryLimit as error:
            reads.append([f"all: {error.line}", R, *[None] * (len(COLUMNS) - 2)])
            continue
        with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
            with progress(f"R = {R}: writing"):
                write_inputs(Path(folder), tree, density, index, points)
                sizes += file_rows(Path(folder), R, tree, density, index)
            found = _measured(folder, R, tree.data_dim, rounds, progress)
        version = next((r[0].facts["version"] for r in found.values() if r[0].facts.get("version")), version)
        reads += figures(R, found)
        rays += ray_rows(R, density, cameras, progress)
    head = {"scene": f"{name}: {scene}", "rounds": str(rounds), **environment(*PACKAGES), "NanoVDB": version or "-"}
    tables = [Table("Trilinear reads", COLUMNS, reads), Table("Files", FILE_COLUMNS, sizes)]
    if cameras:
        tables.insert(1, ray_table(rays))
    return Report(f"Access to a sparse volume: {name}", head, tables, NOTES + (RAY_NOTES if cameras else []))


def chart_access(report: Report, suffix: str) -> bytes:
    """Plot the time of surface reads against memory for one channel, with a colour for each resolution."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    marks = [
        Mark(row["structure"], row["MB"], row["surface ns"].median, f"R = {row['R']}")
        for row in rows
        if row["channels"] == 1 and row["MB"] is not None
    ]
    title = "One density, read trilinearly on the surface, one thread"
    return scatter(marks, title=title, x="memory, MB", y="ns a read (median)", suffix=suffix)


Reading = tuple[Reader, int]  # the reader, and the number of channels that it reads


def _measured(folder: str, R: int, channels: int, rounds: int, progress: Progress) -> dict[Reading, list[Result]]:
    rows = [(reader, 1) for reader in READERS]
    rows += [(reader, channels) for reader in READERS if reader.all and channels > 1]
    results: dict[Reading, list[Result]] = {row: [] for row in rows}
    for turn in range(rounds):
        for reader, C in rows:
            if (found := results[reader, C]) and found[0].error:
                continue
            arguments = {"name": reader.name, "channels": C, "kinds": KINDS, "limit": memory.left()}
            with progress(f"R = {R}, {reader.name}, {C} channels: round {turn + 1} of {rounds}"):
                found.append(measure(reading, folder=folder, **arguments))
    return results


def figures(R: int, results: dict[Reading, list[Result]]) -> list[list[Any]]:
    """Return the table rows of one resolution, one for each reader and number of channels."""

    def over_rounds(found: list[Result], kind: int) -> Statistics:
        return Statistics.of([result.facts["found"][kind][0] for result in found])

    good = {row: found for row, found in results.items() if not found[0].error}
    surface = {row: over_rounds(found, KINDS.index("surface")).median for row, found in good.items()}
    nanovdb = min((ns for (reader, _), ns in surface.items() if reader.name.startswith("NanoVDB")), default=None)
    sums = {C: found[0].facts["found"] for (reader, C), found in good.items() if reader.name == REFERENCE}
    cells: list[list[Any]] = []
    for (reader, C), found in results.items():
        if found[0].error:
            cells.append([f"{reader.name}: {found[0].error}", R, C, *[None] * (len(COLUMNS) - 3)])
            continue
        ratio = surface[reader, C] / nanovdb if nanovdb and C == 1 else None
        agree = all(
            abs(ours[1] - theirs[1]) <= AGREE * theirs[2]
            for result in found
            for ours, theirs in zip(result.facts["found"], sums[C], strict=True)
        )
        times = [over_rounds(found, kind) for kind in range(len(KINDS))]
        cells.append([reader.name, R, C, *times, ratio, found[0].facts["bytes"] / 1e6, agree])
    return cells
