"""What other programs trained, baked by `nerfbake svo` as whole processes: seconds, memory, and what the octree loses.

The files are made of the real chair: a lattice of Plenoxels, and one of DirectVoxGO with 12 features and an MLP of
2x128 units that is fitted to the chair's colours. Seconds hold what the command does: reading, sampling, fitting
harmonics, writing, and its report of decibels and colours. Modules and kernels are compiled before the clock runs.

A smaller lattice of Plenoxels tells what its voxels look like, fine and coarse, beside what svox2's own program makes
of it: the coefficients as they are, a cell for each node.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.aims import FINER, INPUTS, Aim, aims_table
from benchmarks.scenes import Scenes
from nerfbake import (
    LatticeField,
    N3Tree,
    build_octree,
    compare_scenes,
    load,
    measure_lattice,
    octree_of_lattice,
    orbit_cameras,
)
from nerfbake.bench.environment import environment
from nerfbake.bench.inputs.copies import copied
from nerfbake.bench.inputs.models import write_plenoxels, write_voxels
from nerfbake.bench.measure import Statistics, in_turn
from nerfbake.bench.process import measure_process
from nerfbake.bench.progress import told
from nerfbake.bench.report import Report, Table
from nerfbake.scene.camera import Cameras
from nerfbake.scene.octree import SparseVoxelOctree

ROUNDS = 3
PLENOXELS, VOXELS = 256, 160  # nodes along each axis
STEPS = 500  # of fitting the MLP
FRAMES, EDGE = 4, 200  # of the pictures that tell what voxels lose, as `svo` makes them
SMALL = 64  # nodes along each axis of the lattice whose voxels are looked at
SMALL_FRAMES, SMALL_EDGE = 5, 160
COLUMNS = ["input", "nodes", "MB", "s", "peak MB", "voxels", "OUT MB", "PSNR dB", "colours RMS"]
NOTES = [
    "s: of the whole command, its report included; median [min..max]. peak: of the process, the median.",
    "PSNR: of four pictures of the octree to the lattice's own, as the command tells it; RMS: of its colours to the "
    "lattice's in 400 directions, in 0 to 255.",
    "copied: what are sums cut at 0 in the checkpoint are shown through a sigmoid, and nothing is interpolated.",
]


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    with tempfile.TemporaryDirectory() as folder:
        octree = build_octree(load(scenes.chair, N3Tree))
        plenoxels, voxels = Path(folder) / "ckpt.npz", Path(folder) / "fine_last.tar"
        with told(f"{plenoxels.name} of {PLENOXELS}^3"):
            write_plenoxels(plenoxels, octree, PLENOXELS)
        with told(f"{voxels.name} of {VOXELS}^3"):
            write_voxels(voxels, octree, VOXELS, steps=STEPS)
        rows = [_row(path, edge, rounds) for path, edge in ((plenoxels, PLENOXELS), (voxels, VOXELS))]
        finer, decibels = _finer(scenes, Path(folder))
    head = {"scene": scenes.chair.name, "rounds": str(rounds), **environment("numpy", "numba")}
    tables = [Table("`nerfbake svo IN out.svo.npz`", COLUMNS, rows), finer, _aims(rows, decibels)]
    return {"inputs": [Report("Other programs' checkpoints, baked", head, tables, NOTES)]}


def _row(path: Path, edge: int, rounds: int) -> list[Any]:
    out = path.with_name("out.svo.npz")
    command: list[str | Path] = [sys.executable, "-m", "nerfbake", "svo", path, out, "--force", "-q"]
    with told(f"svo {path.name}, {rounds} rounds"):
        (runs,) = in_turn(partial(measure_process, *command), rounds=rounds)
    lattice, octree = load(path, LatticeField), load(out, SparseVoxelOctree)
    views = orbit_cameras(lattice, frames=FRAMES, width=EDGE, height=EDGE)
    decibels = _decibels(lattice, octree, views)
    return [
        path.name,
        f"{edge}^3",
        path.stat().st_size / 1e6,
        Statistics.of([run.seconds for run in runs]),
        statistics.median(run.peak for run in runs) / 1e6,
        f"{octree.size[0]}^3",
        out.stat().st_size / 1e6,
        f"{decibels:.2f}",
        f"{measure_lattice(lattice, octree):.2f}",
    ]


def _finer(scenes: Scenes, folder: Path) -> tuple[Table, dict[int, float]]:
    """What voxels of a small lattice look like, and the dB by voxels for each node."""
    path = folder / "small.ckpt.npz"
    with told(f"{path.name} of {SMALL}^3, as voxels"):
        write_plenoxels(path, build_octree(load(scenes.chair, N3Tree), resolution=SMALL), SMALL)
        lattice = load(path, LatticeField)
        views = orbit_cameras(lattice, frames=SMALL_FRAMES, width=SMALL_EDGE, height=SMALL_EDGE)
        ways = {"copied, as svox2's to_svox1 does": copied(lattice)}
        ways |= {
            f"{times}x, refitted": octree_of_lattice(lattice, resolution=(times * SMALL,) * 3) for times in (1, *FINER)
        }
        found = {way: (octree, _decibels(lattice, octree, views)) for way, octree in ways.items()}
    rows = [
        [way, f"{octree.size[0]}^3", int(octree.childless.sum()), f"{dB:.1f}"] for way, (octree, dB) in found.items()
    ]
    title = f"The chair as {SMALL}^3 nodes of Plenoxels: voxels by its own pictures, {SMALL_FRAMES} of {SMALL_EDGE}^2"
    table = Table(title, ["voxels", "resolution", "leaves", "PSNR dB"], rows)
    return table, {times: found[f"{times}x, refitted"][1] for times in FINER}


def _decibels(lattice: LatticeField, octree: SparseVoxelOctree, views: Cameras) -> float:
    return float(compare_scenes(lattice, octree, views, keep_pictures=False).means["a_b"]["psnr"])


def _aims(rows: list[list[Any]], decibels: dict[int, float]) -> Table:
    found: list[tuple[str, Aim, float | None]] = []
    for name, _, _, seconds, peak, *_ in rows:
        for what, figure in (("s", seconds.median), ("peak MB", peak)):
            if (name, what) in INPUTS:
                found.append((f"{name}: {what}", INPUTS[name, what], figure))
    found += [(f"{times}x, refitted: dB", FINER[times], dB) for times, dB in decibels.items()]
    return aims_table(found)
