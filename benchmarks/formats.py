"""`nerfbake bench formats` on a sample of about the size in TR-24-01, 110 MB of arrays, and on the real chair.

The report is cited in docs/sources.md. If the real chair is missing, only the sample is measured. The
aims are ratios to `raw`, and to plain uses of libraries.
"""

from __future__ import annotations

from collections.abc import Iterator

from benchmarks.aims import BULK_DECODE, BULK_ENCODE, FASTER_THAN, PROTOBUF_SIZE, Aim, aims_table
from benchmarks.processes import announced
from benchmarks.scenes import Scenes
from nerfbake import build_octree, load
from nerfbake.bench.formats.comparison import chart_formats, compare_formats
from nerfbake.bench.report import Report, Table
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree

ROUNDS = 5
SAMPLE = "sample SH16"
BULK = ("svo.pb bulk", "svo.fb bulk", "svo.capnp bulk")

chart = chart_formats


def reports(scenes: Scenes, *, rounds: int = ROUNDS) -> dict[str, list[Report]]:
    found = []
    for name, octree in _octrees(scenes):
        report = compare_formats(octree, name, rounds=rounds, formats=(), progress=announced)
        figures, *others = report.tables
        found.append(report._replace(tables=[figures, _aims(figures), *others]))
    return {"formats": found}


def _octrees(scenes: Scenes) -> Iterator[tuple[str, SparseVoxelOctree]]:
    yield SAMPLE, build_octree(load(scenes.sample(SAMPLE), N3Tree))
    if scenes.chair.exists():
        yield f"{scenes.chair.name} at 128^3", build_octree(load(scenes.chair, N3Tree), resolution=128)


def _aims(figures: Table) -> Table:
    cells = {row[0]: dict(zip(figures.columns, row, strict=True)) for row in figures.rows}
    rows: list[tuple[str, Aim, float | None]] = []
    for name in BULK:
        rows.append((f"{name}: encode, x raw", BULK_ENCODE, cells[name]["encode x raw"]))
        rows.append((f"{name}: decode, x raw's encode", BULK_DECODE, cells[name]["decode x raw"]))
    rows.append(("svo.pb report: size, x raw", PROTOBUF_SIZE, cells["svo.pb report"]["size x raw"]))
    for (ours, other), aim in FASTER_THAN.items():
        times = cells[other]["encode ms"].median / cells[ours]["encode ms"].median
        rows.append((f"{ours}: times as fast as {other}", aim, times))
    return aims_table(rows)
