"""Compare nerfbake with OpenVDB's programs on the real chair: writing .nvdb and .vdb, and reading .vdb.

Each row is a step that takes turns with the program it is compared with; ratios are within a round. Every round uses a
new octree object, without cached results of earlier rounds. Needs Debian's OpenVDB (`make tools`).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.aims import NANOVDB_BUILD_AND_WRITE, OPENVDB_WRITE, Aim
from benchmarks.processes import announced, in_turn, measure_process
from benchmarks.scenes import Scenes
from nerfbake import IndexGrid, N3Tree, SparseVoxelOctree, VdbTree, Volume, build_octree, build_vdb, load, save
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Statistics, seconds_of
from nerfbake.bench.report import Report, Table

ROUNDS = 15
COLUMNS = ["step", "beside", "ours ms", "theirs ms", "ratio", "aim", "holds", "MB", "their MB", "same voxels"]
NOTES = [
    "Medians [min..max]; a ratio is within a round. A load average above 0 "
    "before the run means that other work shared the cores.",
    "build: from the octree in memory to grids; write: from grids to a file. `nerfbake vdb` is the whole process: "
    "Python's start and imports, reading the octree (.svo.npz), build and write.",
    "nanovdb_convert is also a whole process: it reads our .vdb of the same grid and writes a .nvdb with all "
    "statistics and a partial checksum; ours has the same.",
    "pyopenvdb gets the voxels as a dense array, copies it into a grid and writes the grid (blosc). It reads with "
    "readAll and evalMinMax, since it loads values on demand. Python's start does not count.",
    "Building has no aim relative to pyopenvdb, which gets a dense array. nerfbake starts from an octree, and checks "
    "its structure and its values first, which takes nearly half of the building.",
]

_WRITE = """
import sys, time, numpy, pyopenvdb
dense = numpy.load(sys.argv[1])
start = time.perf_counter()
grid = pyopenvdb.FloatGrid()
grid.copyFromArray(dense)
pyopenvdb.write(sys.argv[2], grids=[grid])
print(time.perf_counter() - start)
"""
# pyopenvdb reads values on demand; evalMinMax reads all of them.
_READ = """
import sys, time, pyopenvdb
start = time.perf_counter()
for grid in pyopenvdb.readAll(sys.argv[1])[0]:
    grid.evalMinMax()
print(time.perf_counter() - start)
"""


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    octree = build_octree(load(scenes.chair, N3Tree))
    volume = build_vdb(octree, grids=("density",))
    with tempfile.TemporaryDirectory() as folder, announced(f"writing and reading volumes, {rounds} rounds in turn"):
        measured = _rows(octree, volume, Path(folder), rounds)
    voxels = f"{volume.grids[0].topology.m:,} voxels"
    head = {"scene": f"{scenes.chair.name} at {max(octree.size)}^3, density, {voxels}, float32", "rounds": str(rounds)}
    head |= environment("numpy", "zlib-ng", "blosc", "nerfbake")
    head |= {"OpenVDB and NanoVDB": _debian("libopenvdb-tools")}
    return {"vdb": [Report("Volumes compared with OpenVDB", head, [Table("Chair", COLUMNS, measured)], NOTES)]}


def _rows(octree: SparseVoxelOctree, volume: Volume, folder: Path, rounds: int) -> list[list[Any]]:
    grid = volume.grids[0]
    dense = np.zeros(octree.size, np.float32)
    dense[tuple(grid.topology.coords.T)] = grid.values[:, 0]
    np.save(folder / "dense.npy", dense)
    save(folder / "octree.svo.npz", octree)
    save(folder / "a.vdb", volume)

    def write(name: str, *, build: bool, **options: Any) -> None:
        made = build_vdb(replace(octree), grids=("density",)) if build else volume
        save(folder / name, made, force=True, **options)

    def steps(name: str) -> list[Callable[[], float]]:
        return [partial(_ours, partial(write, name, build=build)) for build in (False, True)]

    def megabytes(name: str) -> float:
        return (folder / name).stat().st_size / 1e6

    convert = ("nanovdb_convert", "-f", "-c", "partial", "-s", "all", folder / "a.vdb", folder / "theirs.nvdb")
    whole = (sys.executable, "-m", "nerfbake", "vdb", folder / "octree.svo.npz", folder / "whole.nvdb", "--force", "-q")
    nvdb = in_turn(*steps("a.nvdb"), partial(_process, *whole), partial(_process, *convert), rounds=rounds)
    stored = partial(_ours, partial(write, "stored.vdb", build=True, codec="none"))
    their_write = partial(_pyopenvdb, _WRITE, folder / "dense.npy", folder / "theirs.vdb")
    vdb = in_turn(*steps("b.vdb"), stored, their_write, rounds=rounds)
    read = in_turn(
        partial(_ours, partial(load, folder / "a.vdb", Volume)),
        partial(_ours, partial(load, folder / "theirs.vdb", Volume)),
        partial(_pyopenvdb, _READ, folder / "theirs.vdb"),
        rounds=rounds,
    )
    same, same_vdb = (_same(load(folder / f"theirs.{name}", Volume).grids[0], grid) for name in ("nvdb", "vdb"))
    sizes, vdb_sizes = (megabytes("a.nvdb"), megabytes("theirs.nvdb")), (megabytes("b.vdb"), megabytes("theirs.vdb"))
    rest = (vdb_sizes[1], same_vdb)
    return [
        _row(".nvdb, write", "nanovdb_convert", nvdb[0], nvdb[3], None, *sizes, same),
        _row(".nvdb, build and write", "nanovdb_convert", nvdb[1], nvdb[3], NANOVDB_BUILD_AND_WRITE, *sizes, same),
        _row(".nvdb, `nerfbake vdb`", "nanovdb_convert", nvdb[2], nvdb[3], None, *sizes, same),
        _row(".vdb, write", "pyopenvdb", vdb[0], vdb[3], OPENVDB_WRITE, *vdb_sizes, same_vdb),
        _row(".vdb, build and write", "pyopenvdb", vdb[1], vdb[3], None, *vdb_sizes, same_vdb),
        _row(".vdb `--codec none`, build and write", "pyopenvdb", vdb[2], vdb[3], None, megabytes("stored.vdb"), *rest),
        _row(".vdb (our zip), read", "pyopenvdb, blosc", read[0], read[2], None, *vdb_sizes, same_vdb),
        _row(".vdb (their blosc), read", "pyopenvdb, blosc", read[1], read[2], None, *vdb_sizes, same_vdb),
    ]


def _row(step: str, beside: str, own: list[float], theirs: list[float], aim: Aim | None, *facts: Any) -> list[Any]:
    ratio = Statistics.of([a / b for a, b in zip(own, theirs, strict=True)])
    times = [Statistics.of([second * 1e3 for second in seconds]) for seconds in (own, theirs)]
    return [step, beside, *times, ratio, aim and str(aim), aim and aim.holds(ratio.median), *facts]


def _ours(work: Callable[[], Any]) -> float:
    return seconds_of(work)[1]


def _process(*command: str | Path) -> float:
    return measure_process(*command).seconds


def _pyopenvdb(code: str, *arguments: Path) -> float:
    """The seconds that a pyopenvdb script measures itself, without Python's start."""
    command = ["/usr/bin/python3", "-c", code, *map(str, arguments)]
    return float(subprocess.run(command, check=True, capture_output=True).stdout)


def _same(one: VdbTree | IndexGrid, other: VdbTree | IndexGrid) -> bool:
    same_voxels = np.array_equal(one.topology.coords, other.topology.coords)
    return same_voxels and np.array_equal(one.values, other.values)


def _debian(package: str) -> str:
    query = ["dpkg-query", "-W", "-f", "${Version}", package]
    return f"Debian {subprocess.run(query, check=True, capture_output=True, text=True).stdout}"
