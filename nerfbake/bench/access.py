"""Trilinear reads of one scene in every structure: time, memory, file sizes; PlenVDB's tables 1 and 3 on this machine.

Each figure comes from a process of its own that has read all points once before the clock runs; the rows take turns,
round by round. One thread reads, in our rows as in the others'.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nerfbake import io, memory
from nerfbake.bench._points import kinds_of_points
from nerfbake.bench._rays import Counts, count_samples
from nerfbake.bench._readers import CONTENDERS, Contender, compile_nanovdb, reading
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result, Spread, measure
from nerfbake.bench.plot import Point, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError, Problem, UsageError
from nerfbake.scene.camera import Camera
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb import VdbTree
from nerfbake.scene.volume import Volume
from nerfbake.stages.n3tree_to_octree import build_octree
from nerfbake.stages.octree_to_vdb import build_vdb

PACKAGES = ("numpy", "numba", "warp-lang")
RESOLUTIONS = (128, 320, 512)
POINTS = 1_000_000
RAYS_EDGE = 400  # pixels of the cameras whose rays are counted
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
RAY_NOTES = [
    "Two passes, as in PlenVDB's table 1: possible: samples at steps of half a voxel in the box of the active voxels; "
    "valid: of these in an active voxel; needed: of these with an opacity from 1e-4 on, before the transmittance falls "
    "below 1e-4. Nearest voxel.",
]

Scene = N3Tree | SparseVoxelOctree


def compare(
    scene: Scene,
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
    reads, files, rays = [], [], []
    version = ""
    for R in resolutions or (RESOLUTIONS if isinstance(scene, N3Tree) else (max(scene.size),)):
        try:
            with progress(f"R = {R}: building"):
                tree = build_octree(scene, resolution=R) if isinstance(scene, N3Tree) else scene
                density, index = (build_vdb(tree, grids=(g,)) for g in ("density", "index"))
        except MemoryLimit as error:
            reads.append([f"all: {error}", R, *[None] * (len(COLUMNS) - 2)])
            continue
        with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
            with progress(f"R = {R}: writing"):
                _write(Path(folder), tree, density, index, points)
                files += _file_rows(Path(folder), R, tree, density, index)
            found = _measured(folder, R, tree.data_dim, rounds, progress)
        version = next((r[0].facts["version"] for r in found.values() if r[0].facts.get("version")), version)
        reads += _figures(R, found)
        rays += _ray_rows(R, density, cameras, progress)
    head = {"scene": f"{name}: {scene}", "rounds": str(rounds), **environment(*PACKAGES), "NanoVDB": version or "-"}
    tables = [Table("Trilinear reads", COLUMNS, reads), Table("Files", ["file", "R", "MB"], files)]
    if cameras:
        columns = ["R", "cameras", "", "possible M", "valid M", "valid %", "needed M", "needed %"]
        tables.insert(1, Table(f"Samples along rays, {RAYS_EDGE}x{RAYS_EDGE}", columns, rays))
    return Report(f"Access to a sparse volume: {name}", head, tables, NOTES + (RAY_NOTES if cameras else []))


def chart(report: Report, suffix: str) -> bytes:
    """Time on the surface against memory, one channel, a colour for each resolution."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    points = [
        Point(row["structure"], row["MB"], row["surface ns"].median, f"R = {row['R']}")
        for row in rows
        if row["channels"] == 1 and row["MB"] is not None
    ]
    title = "One density, read trilinearly on the surface, one thread"
    return scatter(points, title=title, x="memory, MB", y="ns a read (median)", suffix=suffix)


def _write(folder: Path, tree: SparseVoxelOctree, density: Volume, index: Volume, points: int) -> None:
    """What the children read."""
    topology = density.grids[0].topology
    if not topology.m:
        raise InvalidScene(Problem("the scene", "has no voxel", "a density above 0"))
    for kind, some in kinds_of_points(tree.size, topology, points).items():
        some.tofile(folder / f"{kind}.f32")
    compile_nanovdb(folder)
    io.save(folder / "octree.svo.npz", tree)
    io.save(folder / "density.nvdb", density)
    io.save(folder / "index.nvdb", index)


def _file_rows(folder: Path, R: int, tree: SparseVoxelOctree, density: Volume, index: Volume) -> list[list[Any]]:
    """The size of every file that could be written of the scene, or why it could not: a format has its limits, and
    float16 does not hold every scene.
    """
    path = folder / "file"

    def row(what: str, scene: Any, to: str, **options: Any) -> list[Any]:
        try:
            return [what, R, io.save(path, scene, to=to, force=True, **options) / 1e6]
        except NerfbakeError as error:
            return [f"{what}: {str(error).removeprefix(f'{path}: ')}", R, None]

    rows = [row(f"octree .{to}", tree, to) for to in ("svo.npz", "svo.pb")]
    for what, volume, endings in (("density", density, ("nvdb", "vdb")), ("index", index, ("nvdb",))):
        try:
            half = build_vdb(tree, grids=(what,), half=True)
        except InvalidScene as error:
            rows.append([f"{what} half: {error}", R, None])
            half = None
        for to, codec in product(endings, ("none", "zip")):
            packed = " zip" if codec == "zip" else ""
            rows.append(row(f"{what} .{to}{packed}", volume, to, codec=codec))
            if half:
                rows.append(row(f"{what} .{to} half{packed}", half, to, codec=codec))
    return rows


Row = tuple[Contender, int]


def _measured(folder: str, R: int, channels: int, rounds: int, progress: Progress) -> dict[Row, list[Result]]:
    rows = [(row, 1) for row in CONTENDERS]
    rows += [(row, channels) for row in CONTENDERS if row.all and channels > 1]
    results: dict[Row, list[Result]] = {row: [] for row in rows}
    for turn in range(rounds):
        for contender, C in rows:
            if (found := results[contender, C]) and found[0].error:
                continue
            arguments = {"name": contender.name, "channels": C, "kinds": KINDS, "limit": memory.left()}
            with progress(f"R = {R}, {contender.name}, {C} channels: round {turn + 1} of {rounds}"):
                found.append(measure(reading, folder=folder, **arguments))
    return results


def _figures(R: int, results: dict[Row, list[Result]]) -> list[list[Any]]:
    def spread(found: list[Result], kind: int) -> Spread:
        return Spread.of([result.facts["found"][kind][0] for result in found])

    good = {row: found for row, found in results.items() if not found[0].error}
    surface = {row: spread(found, KINDS.index("surface")).median for row, found in good.items()}
    nanovdb = min((ns for (row, _), ns in surface.items() if row.name.startswith("NanoVDB")), default=None)
    sums = {C: found[0].facts["found"] for (row, C), found in good.items() if row.name == REFERENCE}
    cells: list[list[Any]] = []
    for (row, C), found in results.items():
        if found[0].error:
            cells.append([f"{row.name}: {found[0].error}", R, C, *[None] * (len(COLUMNS) - 3)])
            continue
        ratio = surface[row, C] / nanovdb if nanovdb and C == 1 else None
        agree = all(
            abs(ours[1] - theirs[1]) <= AGREE * theirs[2]
            for result in found
            for ours, theirs in zip(result.facts["found"], sums[C], strict=True)
        )
        times = [spread(found, kind) for kind in range(len(KINDS))]
        cells.append([row.name, R, C, *times, ratio, found[0].facts["bytes"] / 1e6, agree])
    return cells


def _ray_rows(R: int, volume: Volume, cameras: Sequence[Camera], progress: Progress) -> list[list[Any]]:
    if not cameras:
        return []
    tree = volume.grids[0]
    assert isinstance(tree, VdbTree)
    counts = []
    for camera in cameras:
        with progress(f"R = {R}: rays of {camera.name}"):
            counts.append(count_samples(volume, tree, camera.resized(RAYS_EDGE, RAYS_EDGE)))
    total = Counts(*map(sum, zip(*counts, strict=True)))
    rows: list[list[Any]] = []
    for what, parts in (("total", 1), ("mean of a camera", len(cameras))):
        millions = [count / parts / 1e6 for count in total]
        valid, needed = (100 * count / max(total.possible, 1) for count in total[1:])
        rows.append([R, len(cameras), what, millions[0], millions[1], valid, millions[2], needed])
    return rows
