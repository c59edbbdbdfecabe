"""Trilinear reads of one scene in every structure: time, memory, file sizes; PlenVDB's tables 1 and 3 on this machine.

Each figure comes from a process of its own that has read all points once before the clock runs; the rows take turns,
round by round. One thread reads, in our rows as in the others'.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nerfbake import memory
from nerfbake.bench.access import files
from nerfbake.bench.access.rays import RAY_NOTES, ray_rows, ray_table
from nerfbake.bench.access.readers import READERS, Reader, reading, write_inputs
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result, Statistics, measure
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.errors import MemoryLimit, UsageError
from nerfbake.scene.camera import Camera
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.stages.n3tree_to_octree import build_octree
from nerfbake.stages.octree_to_vdb import build_vdb

PACKAGES = ("numpy", "numba", "warp-lang")
RESOLUTIONS = (128, 320, 512)
POINTS = 1_000_000
AGREE = 1e-5  # of the sum of absolute values
REFERENCE = "VDB index"
KINDS = ("diagonal", "random", "rays", "surface")
COLUMNS = ["structure", "R", "channels", *(f"{kind} ns" for kind in KINDS), "surface x NanoVDB", "MB", "sums agree"]
NOTES = [
    "ns: one trilinear read, float32 values, one thread, after a pass that does not count: median [min..max].",
    "diagonal: PlenVDB's 800 samples from corner to corner, again and again; random: anywhere in the grid; rays: along "
    "a camera's rays at half a voxel; surface: anywhere in active voxels drawn at random. A million of each.",
    "Points are float32 values in every row, which NanoVDB and Warp take as such, all others as float64.",
    "x NanoVDB: the median against the faster of NanoVDB's two rows at the same R, one channel.",
    "MB: the arrays that are read (NanoVDB, Warp: the grid). VDB keeps its leaves dense, VDB index asks masks.",
    "sums agree: of everything read, with VDB index's, to 1e-5 of the sum of absolute values.",
    "dense pointers: Plenoxels' grid of int32 links. octree: from the root for each of 8 corners; beyond the "
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
    """Measures every row at every resolution and reports; progress(text) surrounds each step.

    An octree has its own resolution only. Raises UsageError where others are asked for, InvalidScene for a scene
    without a voxel. What would take more memory than is allowed is a row that says so.
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
                sizes += files.file_rows(Path(folder), R, tree, density, index)
            found = _measured(folder, R, tree.data_dim, rounds, progress)
        version = next((r[0].facts["version"] for r in found.values() if r[0].facts.get("version")), version)
        reads += figures(R, found)
        rays += ray_rows(R, density, cameras, progress)
    head = {"scene": f"{name}: {scene}", "rounds": str(rounds), **environment(*PACKAGES), "NanoVDB": version or "-"}
    tables = [Table("Trilinear reads", COLUMNS, reads), Table("Files", files.COLUMNS, sizes)]
    if cameras:
        tables.insert(1, ray_table(rays))
    return Report(f"Access to a sparse volume: {name}", head, tables, NOTES + (RAY_NOTES if cameras else []))


def chart_access(report: Report, suffix: str) -> bytes:
    """Time on the surface against memory, one channel, a colour for each resolution."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    marks = [
        Mark(row["structure"], row["MB"], row["surface ns"].median, f"R = {row['R']}")
        for row in rows
        if row["channels"] == 1 and row["MB"] is not None
    ]
    title = "One density, read trilinearly on the surface, one thread"
    return scatter(marks, title=title, x="memory, MB", y="ns a read (median)", suffix=suffix)


Reading = tuple[Reader, int]  # and how many channels it reads


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
    """A row of the table for each reader and number of channels, beside the others of its resolution."""

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
