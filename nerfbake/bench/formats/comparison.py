"""The octree in every format and profile: size, time, memory, exactness, on one's own scene and machine.

The comparison of TR-24-01's appendix B (docs/sources.md), with today's libraries. Each figure comes from a process of
its own; the formats take turns, round by round, after a round that does not count.

    encode   from the arrays in memory to a file, closed but not flushed to the disk
    decode   from the file to arrays of which every value has been read
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from nerfbake.bench.environment import environment
from nerfbake.bench.formats.coding import decoding, encoding, write_scene
from nerfbake.bench.formats.published import FEATURES, PAPER, PAPER_BYTES, WITHDRAWN
from nerfbake.bench.formats.serializations import RAW, Serialization, chosen, serializations
from nerfbake.bench.measure import Result, Statistics, measure
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.scene.octree import SparseVoxelOctree

Results = dict[Serialization, list[Result]]
PACKAGES = ("numpy", "orjson", "pymongo", "zstandard", "protobuf", "flatbuffers", "pycapnp")
NOTES = [
    "encode: from arrays in memory to a written file. decode: until every value has been read. Median [min..max].",
    "x raw: ratio to `raw` (the arrays' bytes, one after the other) in the same run; for decode, to raw's encode.",
    "peak: memory that the step added to its process, pages of the mapped file included.",
    "exact: every bit of both arrays comes back.",
    "report: lists of numbers, as TR-24-01 has them; bulk: one block of memory an array. Rows named after a library "
    "are its own plain use, with the two arrays alone; json.dumps and flatbuffers by element are measured once.",
    f"BinaryFormatter: {WITHDRAWN}.",
]

COLUMNS = ["format", "MB", "size x raw", "encode ms", "encode x raw", "peak MB"]
COLUMNS += ["decode ms", "decode x raw", "decode peak MB", "exact"]


def compare_formats(
    octree: SparseVoxelOctree, name: str, *, rounds: int, formats: Iterable[str], progress: Progress
) -> Report:
    """Measures every row and reports; progress(text) surrounds each step. Raises UsageError for unknown names."""
    rows = chosen(formats)
    encodes: Results = {row: [] for row in rows}
    decodes: Results = {row: [] for row in rows}
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        scene = Path(folder) / "scene.svo.npz"
        write_scene(scene, octree)
        for turn in range(rounds + 1):
            for row in rows:
                if turn and encodes[row] and (row.slow or encodes[row][0].error):
                    continue  # one look is enough
                if not turn and row.slow:
                    continue
                arguments = {"row": row, "scene": str(scene), "target": str(Path(folder) / "target")}
                with progress(f"{row.label}: {f'round {turn} of {rounds}' if turn else 'warming up'}"):
                    encoded = measure(encoding, **arguments)
                    decoded = encoded if encoded.error else measure(decoding, **arguments)
                if turn or encoded.error:
                    encodes[row].append(encoded)
                    decodes[row].append(decoded)
    raw = octree.node_children.nbytes + octree.node_data.nbytes
    head = {
        "scene": f"{name}: {octree}, {raw / 1e6:,.1f} MB raw",
        "rounds": str(rounds),
        **environment(*PACKAGES),
    }
    tables = [_figures(rows, encodes, decodes, raw), FEATURES]
    if raw / 2 < PAPER_BYTES < raw * 2:
        tables.append(PAPER)
    return Report(f"Serializations of an octree: {name}", head, tables, NOTES)


def chart_formats(report: Report, suffix: str) -> bytes:
    """Size against the time to write, a point for each row that was measured."""
    marks = []
    for row in report.tables[0].rows:
        cells = dict(zip(COLUMNS, row, strict=True))
        if cells["MB"] is not None:
            marks.append(Mark(cells["format"], cells["encode ms"].median, cells["MB"], _group(cells["format"])))
    scene = report.head["scene"]
    return scatter(marks, title=f"Writing an octree: {scene}", x="encode, ms (median)", y="file, MB", suffix=suffix)


def _group(label: str) -> str:
    row = next(row for row in serializations() if row.label == label)
    return {RAW: "floor", "library": "the libraries' own use"}.get(
        row.kind, "nerfbake, compressed" if row.packed else "nerfbake"
    )


def _figures(rows: list[Serialization], encodes: Results, decodes: Results, raw: int) -> Table:
    floor = Statistics.of([result.seconds for result in encodes[rows[0]]]).median
    cells: list[list[Any]] = []
    for row in rows:
        encoded, decoded = encodes[row], decodes[row]
        if error := next((result.error for result in encoded + decoded if result.error), ""):
            cells.append([f"{row.label}: {error}", *[None] * (len(COLUMNS) - 1)])
            continue
        size = encoded[0].facts["size"]
        times = [Statistics.of([1e3 * result.seconds for result in results]) for results in (encoded, decoded)]
        peaks = [max(result.peak for result in results) / 1e6 for results in (encoded, decoded)]
        exact = all(result.facts["exact"] for result in decoded)
        ratios = [time.median / 1e3 / floor for time in times]
        cells.append(
            [row.label, size / 1e6, size / raw, times[0], ratios[0], peaks[0], times[1], ratios[1], peaks[1], exact]
        )
    return Table("Formats", COLUMNS, cells)
