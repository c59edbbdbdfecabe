"""The rows of `bench access`: each reads the same points out of a structure of its own, on one thread.

A reader is prepared from a folder that holds the scene at one resolution:

    octree.svo.npz   the octree                density.nvdb, index.nvdb   its voxels, uncompressed
    NAME.f32         points of each kind, 3 x float32 in voxels
    nanovdb          nanovdb_reader.cpp, compiled
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import io
from nerfbake.bench.access import structures
from nerfbake.bench.access.nanovdb import compile_nanovdb, reading_in_cpp
from nerfbake.bench.access.points import kinds_of_points
from nerfbake.bench.measure import Work, seconds_of
from nerfbake.errors import InvalidScene, MemoryLimit, NerfbakeError, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.vdb.accessor import trilinear
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import Volume

TOO_SLOW = "not measured: Debian's python3-openvdb asks its accessor voxel by voxel from Python, 2.5 microseconds each"


class Reader(NamedTuple):
    """A row; whether it can read all channels too, not only the density."""

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
    """What the readers are prepared from. Raises InvalidScene for a scene without a voxel."""
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
    """The work of reading every kind of points once, after a pass that does not count; in a process of its own.

    limit: most bytes that a dense structure may take.
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
    """One of our own rows, made from the folder. Raises MemoryLimit for a dense one that takes more than the limit."""
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
