"""The rows of `bench access`: each reads the same points out of a structure of its own, on one thread.

A contender is prepared from a folder that holds the scene at one resolution:

    octree.svo.npz   the octree                density.nvdb, index.nvdb   its voxels, uncompressed
    NAME.f32         points of each kind, 3 x float32 in voxels
    nanovdb          nanovdb_access.cpp, compiled
"""

from __future__ import annotations

import os
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from shutil import which
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import io
from nerfbake.bench import _structures
from nerfbake.bench.measure import Work
from nerfbake.errors import MemoryLimit, NerfbakeError
from nerfbake.kernels.vdb.accessor import Floats, trilinear
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import Volume

Read = Callable[[npt.NDArray[np.float32]], npt.NDArray[np.float32]]
FLAGS = ("-O3", "-march=native", "-std=c++17", "-DNDEBUG")
SOURCE = Path(__file__).with_name("nanovdb_access.cpp")
TOO_SLOW = "not measured: Debian's python3-openvdb asks its accessor voxel by voxel from Python, 2.5 microseconds each"


class Contender(NamedTuple):
    """A row; whether it can read all channels too, not only the density."""

    name: str
    all: bool = True


CONTENDERS = (
    Contender("dense array"),
    Contender("dense pointers"),
    Contender("octree"),
    Contender("VDB", all=False),
    Contender("VDB index"),
    Contender("OpenVDB C++", all=False),
    Contender("NanoVDB C++", all=False),
    Contender("NanoVDB C++, no stencil cache", all=False),
    Contender("Warp", all=False),
)


def compile_nanovdb(folder: Path) -> None:
    """Leaves the program in the folder, or a text that says why there is none."""
    missing = folder / "nanovdb.missing"
    if (compiler := which("g++")) is None:
        missing.write_text("no g++ here (Debian: g++)")
        return
    command = [compiler, *FLAGS, str(SOURCE), "-o", str(folder / "nanovdb")]
    english = {**os.environ, "LC_ALL": "C"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=english)
    if "nanovdb/util/IO.h: No such file" in done.stderr:
        missing.write_text("no headers of NanoVDB here (Debian: libnanovdb-dev)")
    elif done.returncode:
        missing.write_text(f"g++ {next(line for line in done.stderr.splitlines() if 'error' in line)}")


def reading(name: str, folder: str, channels: int, kinds: list[str], limit: int) -> Work:
    """The work of reading every kind of points once, after a pass that does not count; in a process of its own.

    limit: most bytes that a dense structure may take.
    """
    if name == "OpenVDB C++":
        raise NerfbakeError(TOO_SLOW)
    home = Path(folder)
    files = [home / f"{kind}.f32" for kind in kinds]
    if name.startswith("NanoVDB"):
        return _nanovdb(home, files, stencil="no stencil" not in name)
    points = [np.fromfile(file, np.float32).reshape(-1, 3) for file in files]
    read, size = _warp(home) if name == "Warp" else _ours(name, home, channels, limit)

    def run() -> list[tuple[float, float, float]]:
        found = []
        for some in points:
            work = read(some)
            work()
            start = time.perf_counter()
            values = work()
            seconds = time.perf_counter() - start
            found.append((1e9 * seconds / len(some), float(values.sum(dtype=np.float64)), _size(values)))
        return found

    return Work(run, lambda found: {"found": found, "bytes": size, "version": ""})


def _size(values: npt.NDArray[np.float32]) -> float:
    return float(np.abs(values).sum(dtype=np.float64))


def _ours(name: str, home: Path, channels: int, limit: int) -> tuple[Any, int]:
    structure = _structure(name, home, channels, limit)

    def read(points: npt.NDArray[np.float32]) -> Any:
        places, out = points.astype(np.float64), np.empty((len(points), channels), np.float32)

        def work() -> Floats:
            structure.read(*structure.arrays, places, out)
            return out

        return work

    return read, structure.nbytes


def _structure(name: str, home: Path, channels: int, limit: int) -> _structures.Structure:
    tree = io.load(home / "octree.svo.npz", SparseVoxelOctree)
    if name == "octree":
        return _structures.octree(tree, channels)
    voxels = int(np.prod(tree.size))
    need = {"dense array": 4 * channels * voxels, "dense pointers": 4 * voxels}.get(name, 0)
    if need > limit:
        raise MemoryLimit("it", need, limit)
    grid = io.load(home / ("density.nvdb" if channels == 1 else "index.nvdb"), Volume).grids[0]
    topology = grid.topology
    if name == "VDB":
        return _structures.Structure(trilinear, (topology.tables, *grid.rows))
    table = np.zeros((topology.m + 1, channels), np.float32)
    table[1:] = grid.values
    if name == "VDB index":
        return _structures.Structure(trilinear, (topology.tables, False, table))
    make = _structures.dense if name == "dense array" else _structures.pointers
    return make(tree.size, topology, table[1:])


def _warp(home: Path) -> tuple[Any, int]:
    from nerfbake.bench._warp_access import reader

    grid = (home / "density.nvdb").read_bytes()

    def read(points: npt.NDArray[np.float32]) -> Any:
        out = np.empty(len(points), np.float32)
        launch = reader(grid, points, out)

        def work() -> npt.NDArray[np.float32]:
            launch()
            return out

        return work

    return read, len(grid)


def _nanovdb(home: Path, files: list[Path], *, stencil: bool) -> Work:
    if (missing := home / "nanovdb.missing").exists():
        raise NerfbakeError(missing.read_text())
    grid = home / "density.nvdb"

    def run() -> str:
        command = [home / "nanovdb", grid, "1" if stencil else "0", *files]
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout

    def check(printed: str) -> dict[str, Any]:
        version, *lines = printed.splitlines()
        found = [[float(word) for word in line.split()] for line in lines]
        return {"found": found, "bytes": grid.stat().st_size, "version": version}

    return Work(run, check)
