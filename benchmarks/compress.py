"""`nerfbake bench compress` on the real chair, measured on its five held-out views.

The aims are for a file of 0.1 dB: its bytes in either coding, and the time and memory of writing and reading it. A
second report compares the promised loss with the measured one, on the scenes of promises.py.
"""

from __future__ import annotations

import numpy as np

from benchmarks.aims import COMPRESS, aims_table
from benchmarks.processes import announced
from benchmarks.promises import promise_report
from benchmarks.scenes import Scenes
from nerfbake import N3Tree, build_octree, load
from nerfbake.bench.compress import COLUMNS, chart_compression, compare_compression
from nerfbake.bench.report import Report, Table

ROUNDS = 3

chart = chart_compression


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    octree = build_octree(load(scenes.chair, N3Tree))
    photographs = {"cameras": str(scenes.views / "transforms.json"), "truth": str(scenes.views)}
    report = compare_compression(octree, scenes.chair.name, **photographs, rounds=rounds, progress=announced)
    arrays = (np.asarray(octree.node_data).nbytes + octree.node_children.nbytes) / 1e6
    packed = report._replace(tables=[*report.tables, _aims(report, arrays)])
    return {"compress": [packed], "compress_promises": [promise_report(scenes)]}


def _aims(report: Report, arrays: float) -> Table:
    """arrays: megabytes of the octree in memory."""
    rows = {row[0]: dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows}
    file, deflated = (rows[f"svoq {coding}, 0.1 dB"] for coding in ("range", "deflate"))
    figures = {
        "range: MB": file["MB"],
        "deflate: MB": deflated["MB"],
        "measured dB": file["measured dB"],
        "encode s": file["encode s"].median,
        "decode s": file["decode s"].median,
        "encoding's peak, x the octree": file["peak MB"] / arrays,
    }
    return aims_table([(what, COMPRESS[what], figure) for what, figure in figures.items()])
