"""What writing a VDB costs beside OpenVDB's own programs, in turns: `python benchmarks/vdb.py chair_sh9.npz`.

nanovdb_convert reads a .vdb and writes a .nvdb, as a process; pyopenvdb copies a dense array and writes a .vdb (blosc).
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from nerfbake import N3Tree, build_octree, build_vdb, load, save
from nerfbake.bench.measure import Spread

ROUNDS = 7
COPY = """
import sys, time, numpy, pyopenvdb
dense = numpy.load(sys.argv[1])
start = time.perf_counter()
grid = pyopenvdb.FloatGrid()
grid.copyFromArray(dense)
pyopenvdb.write(sys.argv[2], grids=[grid])
print(time.perf_counter() - start)
"""


def main(source: str) -> None:
    octree = build_octree(load(source, N3Tree))
    volume = build_vdb(octree, grids=("density",))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        save(folder / "a.vdb", volume)
        dense = np.zeros(octree.size, np.float32)
        dense[tuple(volume.grids[0].topology.coords.T)] = volume.grids[0].values[:, 0]
        np.save(folder / "dense.npy", dense)

        def ours(file: str, *, build: bool) -> float:
            start = time.perf_counter()
            save(folder / file, build_vdb(octree, grids=("density",)) if build else volume, force=True)
            return time.perf_counter() - start

        def convert() -> float:
            start = time.perf_counter()
            subprocess.run(
                ["nanovdb_convert", "-f", folder / "a.vdb", folder / "b.nvdb"], check=True, capture_output=True
            )
            return time.perf_counter() - start

        def pyopenvdb() -> float:
            command = ["/usr/bin/python3", "-c", COPY, str(folder / "dense.npy"), str(folder / "b.vdb")]
            return float(subprocess.run(command, check=True, capture_output=True).stdout)

        compare("nvdb", convert, lambda build: ours("c.nvdb", build=build))
        compare("vdb", pyopenvdb, lambda build: ours("c.vdb", build=build))


def compare(name: str, theirs: Callable[[], float], ours: Callable[[bool], float]) -> None:
    """A row for writing alone and one with the octree turned into grids first: ratios of one round."""
    rounds = [(theirs(), ours(False), ours(True)) for _ in range(ROUNDS)]
    for k, what in ((1, "write"), (2, "build and write")):
        own, ratio = Spread.of([r[k] for r in rounds]), Spread.of([r[k] / r[0] for r in rounds])
        print(
            f"{name:<5} {what:<16} {own.median * 1e3:5.0f} ms, {ratio.median:.2f} [{ratio.low:.2f}..{ratio.high:.2f}]"
        )


if __name__ == "__main__":
    main(sys.argv[1])
