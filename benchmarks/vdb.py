"""Volumes of the real chair beside OpenVDB's own programs: writing .nvdb and .vdb, and reading .vdb.

    python benchmarks/vdb.py            rewrites benchmarks/results/vdb.md

Each row is a step that takes turns with the program it is compared with; ratios are of one round. The octree comes
anew every round, so that nothing an earlier one worked out is there. Needs the real chair and Debian's OpenVDB
(`make tools`).
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from nerfbake import IndexGrid, N3Tree, VdbTree, Volume, build_octree, build_vdb, load, save
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Spread
from nerfbake.bench.report import Report, Table, markdown

HERE = Path(__file__).parent
DATA = Path(os.environ.get("NERFBAKE_DATA", HERE.parents[1] / "shared" / "data"))
CHAIR = DATA / "plenoctree" / "chair" / "chair_sh9.npz"
RESULT = HERE / "results" / "vdb.md"
ROUNDS = 15
COLUMNS = ["step", "beside", "ours ms", "theirs ms", "ratio", "aim", "holds", "MB", "their MB", "same voxels"]

_WRITE = """
import sys, time, numpy, pyopenvdb
dense = numpy.load(sys.argv[1])
start = time.perf_counter()
grid = pyopenvdb.FloatGrid()
grid.copyFromArray(dense)
pyopenvdb.write(sys.argv[2], grids=[grid])
print(time.perf_counter() - start)
"""
# Values are read from the file when they are asked for: asking for the extremes reads all.
_READ = """
import sys, time, pyopenvdb
start = time.perf_counter()
for grid in pyopenvdb.readAll(sys.argv[1])[0]:
    grid.evalMinMax()
print(time.perf_counter() - start)
"""


def ours(work: Callable[[], Any]) -> float:
    start = time.perf_counter()
    work()
    return time.perf_counter() - start


def process(*command: str | Path) -> float:
    """Seconds of a whole process."""
    return ours(partial(subprocess.run, list(map(str, command)), check=True, capture_output=True))


def pyopenvdb(code: str, *arguments: Path) -> float:
    """Seconds that a script of theirs measured itself, without Python's own start."""
    command = ["/usr/bin/python3", "-c", code, *map(str, arguments)]
    return float(subprocess.run(command, check=True, capture_output=True).stdout)


def in_turn(*works: Callable[[], float]) -> list[list[float]]:
    """Seconds of each in every round, after one round that does not count."""
    rounds = [[work() for work in works] for _ in range(ROUNDS + 1)][1:]
    return [list(seconds) for seconds in zip(*rounds, strict=True)]


def row(step: str, beside: str, own: list[float], theirs: list[float], aim: float | None, *facts: Any) -> list[Any]:
    ratio = Spread.of([a / b for a, b in zip(own, theirs, strict=True)])
    times = [Spread.of([second * 1e3 for second in seconds]) for seconds in (own, theirs)]
    holds = None if aim is None else ratio.median <= aim
    return [step, beside, *times, ratio, aim and f"at most {aim:g}", holds, *facts]


def rows(folder: Path) -> list[list[Any]]:
    octree = build_octree(load(CHAIR, N3Tree))
    volume = build_vdb(octree, grids=("density",))
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
        return [partial(ours, partial(write, name, build=build)) for build in (False, True)]

    def megabytes(name: str) -> float:
        return (folder / name).stat().st_size / 1e6

    convert = ("nanovdb_convert", "-f", "-c", "partial", "-s", "all", folder / "a.vdb", folder / "theirs.nvdb")
    whole = (sys.executable, "-m", "nerfbake", "vdb", folder / "octree.svo.npz", folder / "whole.nvdb", "--force", "-q")
    nvdb = in_turn(*steps("a.nvdb"), partial(process, *whole), partial(process, *convert))
    stored = partial(ours, partial(write, "stored.vdb", build=True, codec="none"))
    vdb = in_turn(*steps("b.vdb"), stored, partial(pyopenvdb, _WRITE, folder / "dense.npy", folder / "theirs.vdb"))
    read = in_turn(
        partial(ours, partial(load, folder / "a.vdb", Volume)),
        partial(ours, partial(load, folder / "theirs.vdb", Volume)),
        partial(pyopenvdb, _READ, folder / "theirs.vdb"),
    )
    same, same_vdb = (_same(load(folder / f"theirs.{name}", Volume).grids[0], grid) for name in ("nvdb", "vdb"))
    sizes, vdb_sizes = (megabytes("a.nvdb"), megabytes("theirs.nvdb")), (megabytes("b.vdb"), megabytes("theirs.vdb"))
    rest = (vdb_sizes[1], same_vdb)
    return [
        row(".nvdb, write", "nanovdb_convert", nvdb[0], nvdb[3], None, *sizes, same),
        row(".nvdb, build and write", "nanovdb_convert", nvdb[1], nvdb[3], 1.0, *sizes, same),
        row(".nvdb, `nerfbake vdb`", "nanovdb_convert", nvdb[2], nvdb[3], None, *sizes, same),
        row(".vdb, write", "pyopenvdb", vdb[0], vdb[3], 1.0, *vdb_sizes, same_vdb),
        row(".vdb, build and write", "pyopenvdb", vdb[1], vdb[3], None, *vdb_sizes, same_vdb),
        row(".vdb `--codec none`, build and write", "pyopenvdb", vdb[2], vdb[3], None, megabytes("stored.vdb"), *rest),
        row(".vdb (our zip), read", "pyopenvdb, blosc", read[0], read[2], None, *vdb_sizes, same_vdb),
        row(".vdb (their blosc), read", "pyopenvdb, blosc", read[1], read[2], None, *vdb_sizes, same_vdb),
    ]


def main() -> None:
    """Writes benchmarks/results/vdb.md."""
    load_before = os.getloadavg()[0]
    with tempfile.TemporaryDirectory() as folder:
        measured = rows(Path(folder))
    head = {"scene": "chair_sh9.npz at 256^3, density, 629,855 voxels, float32", "rounds": str(ROUNDS)}
    head |= environment("numpy", "zlib-ng", "blosc", "nerfbake")
    head |= {"OpenVDB and NanoVDB": _debian("libopenvdb-tools"), "load before": f"{load_before:.2f}"}
    notes = [
        "Medians [least..greatest]; a ratio is of one round. `python benchmarks/vdb.py`, or `make bench`. "
        "A load above 0 means that other work shared the cores.",
        "build: the octree in memory becomes grids; write: grids become a file. `nerfbake vdb` is the whole process: "
        "Python's start and imports, reading the octree (.svo.npz), build and write.",
        "nanovdb_convert is a whole process, too: it reads our .vdb of the same grid and writes a .nvdb with all "
        "statistics and a partial checksum; ours has the same.",
        "pyopenvdb has the voxels as a dense array, copies it into a grid and writes that (blosc); it reads with "
        "readAll and evalMinMax, since values come when they are asked for. Python's start does not count.",
        "Building has no aim beside pyopenvdb, which is handed a dense array: ours starts from an octree, and proves "
        "it sound and its values usable first, which is nearly half of the building.",
    ]
    report = Report("Volumes beside OpenVDB's own programs", head, [Table("Chair", COLUMNS, measured)], notes)
    RESULT.write_text(markdown(report))
    print(RESULT.read_text())


def _same(one: VdbTree | IndexGrid, other: VdbTree | IndexGrid) -> bool:
    same_voxels = np.array_equal(one.topology.coords, other.topology.coords)
    return same_voxels and np.array_equal(one.values, other.values)


def _debian(package: str) -> str:
    query = ["dpkg-query", "-W", "-f", "${Version}", package]
    return f"Debian {subprocess.run(query, check=True, capture_output=True, text=True).stdout}"


if __name__ == "__main__":
    main()
