"""`nerfbake bench access` on the real chair, with the rays of its 25 test views; at 800^3 one round without rays.

The aim bounds the time of a read on the surface, relative to NanoVDB.
"""

from __future__ import annotations

from benchmarks.aims import SURFACE_READ, aims_table
from benchmarks.processes import announced
from benchmarks.scenes import Scenes
from nerfbake import load
from nerfbake.bench.access.comparison import RESOLUTIONS, chart_access, compare_access
from nerfbake.bench.report import Report, Table
from nerfbake.memory import memory_limit
from nerfbake.scene.camera import Cameras
from nerfbake.scene.n3tree import N3Tree

ROUNDS = 5
FINE, FINE_MEMORY = 800, 12 << 30  # voxels an axis, and the memory limit in bytes

chart = chart_access


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    name, cameras = scenes.chair.name, load(scenes.test_cameras, Cameras).cameras
    tree = load(scenes.chair, N3Tree)
    report = compare_access(tree, name, resolutions=RESOLUTIONS, rounds=rounds, cameras=cameras, progress=announced)
    reads, *others = report.tables
    with memory_limit(FINE_MEMORY):
        fine = compare_access(load(scenes.chair, N3Tree), name, resolutions=[FINE], rounds=1, progress=announced)
    return {"access": [report._replace(tables=[reads, _aims(reads), *others])], "access_800": [fine]}


def _aims(reads: Table) -> Table:
    rows = [dict(zip(reads.columns, row, strict=True)) for row in reads.rows]
    return aims_table(
        (f"VDB at {row['R']}^3: surface, x NanoVDB", SURFACE_READ, row["surface x NanoVDB"])
        for row in rows
        if row["structure"] == "VDB"
    )
