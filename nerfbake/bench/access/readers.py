"""The rows of `bench access`: each reads the same points from a different structure, on one thread.

The points have a fixed seed and are the same for every row. A reader is prepared from a folder with the scene at one
resolution:

    octree.svo.npz   the octree                density.nvdb, index.nvdb   its voxels, uncompressed
    NAME.f32         points of each kind, 3 x float32 in voxels
    nanovdb          nanovdb_reader.cpp, compiled on the current machine: trilinear reads with NanoVDB's sampler
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path
from shutil import which
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import io
from nerfbake.bench.access import structures
from nerfbake.bench.access.rays import STEP
from nerfbake.bench.measure import Work, seconds_of
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.vdb.accessor import trilinear
from nerfbake.scene.camera import Camera, look_at
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import Volume

FLAGS = ("-O3", "-march=native", "-std=c++17", "-DNDEBUG")
SOURCE = Path(__file__).with_name("nanovdb_reader.cpp")
PROGRAM, MISSING = "nanovdb", "nanovdb.missing"  # file names in the folder


def compile_nanovdb(folder: Path) -> None:
    """Compile the program into the folder, or write a text file with the reason why that failed."""
    missing = folder / MISSING
    if (compiler := which("g++")) is None:
        missing.write_text("no g++ here (Debian: g++)")
        return
    command = [compiler, *FLAGS, str(SOURCE), "-o", str(folder / PROGRAM)]
    english = {**os.environ, "LC_ALL": "C"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=english)
    if "nanovdb/util/IO.h: No such file" in done.stderr:
        missing.write_text("no headers of NanoVDB here (Debian: libnanovdb-dev)")
    elif done.returncode:
        missing.write_text(f"g++ {next(line for line in done.stderr.splitlines() if 'error' in line)}")


def reading_in_cpp(folder: Path, files: list[Path], *, stencil: bool) -> Work:
    """The work of reading density.nvdb at the points of each file, with or without the sampler's stencil cache."""
    if (missing := folder / MISSING).exists():
        raise NerfbakeError(missing.read_text())
    grid = folder / "density.nvdb"

    def run() -> str:
        command = [folder / PROGRAM, grid, "1" if stencil else "0", *files]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def check(printed: str) -> dict[str, Any]:
        version, *lines = printed.splitlines()
        found = [[float(word) for word in line.split()] for line in lines]
        return {"found": found, "bytes": grid.stat().st_size, "version": version}

    return Work(run, check)


TOO_SLOW = "not measured: Debian's python3-openvdb reads voxel by voxel from Python, 2.5 microseconds each"


class Reader(NamedTuple):
    """A row of the table. all: it can also read all channels, not only the density."""

    name: str
    all: bool = True


READERS = (
    Reader("dense array"),
    Reader("dense pointers"),
    Reader("octree"),
    Reader("VDB", all=False),
    Reader("VDB index"),
    Reader("OpenVDB C++", all=False),
    Reader("NanoVDB C++", all=False),
    Reader("NanoVDB C++, no stencil cache", all=False),
    Reader("Warp", all=False),
)


def write_inputs(folder: Path, tree: SparseVoxelOctree, density: Volume, index: Volume, points: int) -> None:
    """Write the input files of the readers. Raises InvalidScene for a scene without a voxel."""
    topology = density.grids[0].topology
    if not topology.m:
        raise InvalidScene(Problem("the scene", "has no voxel", "a density above 0"))
    for kind, some in kinds_of_points(tree.size, topology, points).items():
        some.tofile(folder / f"{kind}.f32")
    compile_nanovdb(folder)
    io.save(folder / "octree.svo.npz", tree)
    io.save(folder / "density.nvdb", density)
    io.save(folder / "index.nvdb", index)


def reading(name: str, folder: str, channels: int, kinds: list[str], limit: int) -> Work:
    """The work of reading every kind of points once, after a warm-up pass; called in a child process.

    limit: maximum size of a dense structure in bytes.
    """
    if name == "OpenVDB C++":
        raise NerfbakeError(TOO_SLOW)
    home = Path(folder)
    files = [home / f"{kind}.f32" for kind in kinds]
    if name.startswith("NanoVDB"):
        return reading_in_cpp(home, files, stencil="no stencil" not in name)
    points = [np.fromfile(file, np.float32).reshape(-1, 3) for file in files]
    read, size = _warp(home) if name == "Warp" else _ours(name, home, channels, limit)

    def run() -> list[tuple[float, float, float]]:
        found = []
        for some in points:
            work = read(some)
            work()
            values, seconds = seconds_of(work)
            found.append((1e9 * seconds / len(some), float(values.sum(dtype=np.float64)), _size(values)))
        return found

    return Work(run, lambda found: {"found": found, "bytes": size, "version": ""})


def _size(values: npt.NDArray[np.float32]) -> float:
    return float(np.abs(values).sum(dtype=np.float64))


def _ours(name: str, home: Path, channels: int, limit: int) -> tuple[Any, int]:
    structure = structure_named(name, home, channels, limit)

    def read(points: npt.NDArray[np.float32]) -> Any:
        places, out = points.astype(np.float64), np.empty((len(points), channels), np.float32)

        def work() -> Singles:
            structure.read(*structure.arrays, places, out)
            return out

        return work

    return read, structure.nbytes


def structure_named(name: str, folder: Path, channels: int, limit: int) -> structures.Structure:
    """Build one of nerfbake's structures from the folder. Raises MemoryLimit for a dense one beyond the limit."""
    tree = io.load(folder / "octree.svo.npz", SparseVoxelOctree)
    if name == "octree":
        return structures.octree(tree, channels)
    voxels = int(np.prod(tree.size))
    need = {"dense array": 4 * channels * voxels, "dense pointers": 4 * voxels}.get(name, 0)
    if need > limit:
        raise MemoryLimit("it", need, limit)
    grid = io.load(folder / ("density.nvdb" if channels == 1 else "index.nvdb"), Volume).grids[0]
    topology = grid.topology
    if name == "VDB":
        return structures.Structure(trilinear, (topology.tables, *grid.rows))
    table = np.zeros((topology.m + 1, channels), np.float32)
    table[1:] = grid.values
    if name == "VDB index":
        return structures.Structure(trilinear, (topology.tables, False, table))
    make = structures.dense if name == "dense array" else structures.pointers
    return make(tree.size, topology, table[1:])


def _warp(home: Path) -> tuple[Any, int]:
    from nerfbake.bench.access.warp_reader import launcher

    grid = (home / "density.nvdb").read_bytes()

    def read(points: npt.NDArray[np.float32]) -> Any:
        out = np.empty(len(points), np.float32)
        launch = launcher(grid, points, out)

        def work() -> npt.NDArray[np.float32]:
            launch()
            return out

        return work

    return read, len(grid)


Places = npt.NDArray[np.float32]


DIAGONAL = 800  # samples, as in PlenVDB's table 3; repeated, because one pass takes only microseconds


def kinds_of_points(size: tuple[int, int, int], topology: VdbTopology, count: int) -> dict[str, Places]:
    """About `count` points of each kind, (n, 3) float32; the topology has at least one voxel.

    diagonal   from corner to corner of the grid
    random     anywhere in it
    rays       one after the other along the rays of a camera, row by row, inside the box of the active voxels
    surface    in active voxels drawn at random, anywhere in each
    """
    random = np.random.default_rng(0)
    top = np.array(size) - 1
    coords = topology.coords
    diagonal = np.linspace(0, 1, DIAGONAL)[:, None] * top
    voxels = coords[random.integers(0, len(coords), count)]
    kinds = {
        "diagonal": np.tile(diagonal, (max(1, count // DIAGONAL), 1)),
        "random": random.uniform(0, 1, (count, 3)) * top,
        "rays": _along_rays(topology, count),
        "surface": voxels + random.uniform(-0.5, 0.5, (count, 3)),
    }
    return {kind: points.astype(np.float32) for kind, points in kinds.items()}


def _along_rays(topology: VdbTopology, count: int) -> npt.NDArray[np.float64]:
    box = topology.box
    assert box is not None
    low, high = box[0] - 0.5, box[1] + 0.5
    diagonal = float(np.linalg.norm(high - low))
    pose = look_at((low + high) / 2, np.radians(-50), np.radians(28), DISTANCE * diagonal)
    place, directions = Camera(EDGE, EDGE, FOCAL, pose).rays()
    # The camera's axes are chosen so that no ray is parallel to a face.
    to = (np.stack([low, high])[:, None] - place) / directions  # (2, rays, 3)
    begin, end = to.min(axis=0).max(axis=1), to.max(axis=0).min(axis=1)
    steps = np.maximum(((end - begin) / STEP).astype(np.int64), 0)
    # Start at the middle row, and use as many rays as needed.
    first = EDGE * (EDGE // 2) * (count < steps.sum() // 2)
    steps = steps[first:]
    rays = first + np.repeat(np.arange(len(steps)), steps)[:count]
    n = (np.arange(steps.sum()) - np.repeat(np.cumsum(steps) - steps, steps))[:count]
    return np.asarray(place + directions[rays] * (begin[rays] + n * STEP)[:, None])


EDGE, FOCAL, DISTANCE = 400, 550.0, 1.3  # a camera's pixels and focal length; its distance in diagonals of the box
