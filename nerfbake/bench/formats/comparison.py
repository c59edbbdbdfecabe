"""Benchmark of the octree formats (`bench formats`): size, time, memory and exactness, on any scene and machine.

It repeats the comparison of TR-24-01's appendix B (docs/sources.md) with current libraries, and shows the published
figures next to its own. Each figure comes from a separate process, which writes an octree in one serialization or reads
it. The formats take turns, round by round, after a warm-up round.

    encode   from the arrays in memory to a file, closed but not flushed to the disk
    decode   from the file to arrays of which every value has been read
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import catalog
from nerfbake.bench.environment import environment
from nerfbake.bench.formats.libraries import LIBRARIES
from nerfbake.bench.measure import Progress, Result, Statistics, Work, measure
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.report import Report, Table
from nerfbake.contract import FileFormat
from nerfbake.errors import UsageError
from nerfbake.io.sources import read_file
from nerfbake.scene.octree import SparseVoxelOctree

# Tables 4 and 5: LEGO at 128^3, 420k nodes x 49 float32, on a free Colab CPU.
PAPER = Table(
    "TR-24-01, table 5, as context: another machine and another scene (LEGO at 128^3)",
    ["format", "encode s", "MB"],
    [
        ["JSON", 35.5, 244.8],
        ["BSON", 18.0, 421.0],
        ["Protocol Buffers", 4.4, 120.0],
        ["FlatBuffers", 60.0, 96.0],
        ["Cap'n Proto", 6.8, 96.0],
    ],
)
PAPER_BYTES = 96e6
FEATURES = Table(
    "Features (after TR-24-01, table 4)",
    ["format", "binary", "Python", "C#", "packed arrays", "generic types"],
    [
        ["JSON", False, True, True, False, False],
        ["BSON", True, True, True, "as binary only", False],
        ["Protocol Buffers", True, True, True, True, "by type_url"],
        ["FlatBuffers", True, True, True, True, False],
        ["Cap'n Proto", True, True, True, True, True],
        ["NumPy .npz", True, True, "third party", True, "by dtype"],
        ["BinaryFormatter", True, False, "withdrawn", True, True],
    ],
)
WITHDRAWN = "not measured: .NET only; Microsoft withdrew it as unsafe and took it out of .NET 9"


RAW = "raw"


class Serialization(NamedTuple):
    """One row. kind: raw, format or library, identified by name and profile. packed: compressed with zstd."""

    kind: str
    name: str
    profile: str | None = None
    packed: bool = False
    slow: bool = False

    @property
    def label(self) -> str:
        return f"{self.name}{catalog.COMPRESSED if self.packed else ''}{f' {self.profile}' if self.profile else ''}"


def serializations() -> Iterator[Serialization]:
    """Yield every row: raw bytes, nerfbake's formats in each profile, the same with .zst, and the libraries."""
    forms = catalog.formats_of("SparseVoxelOctree")
    ours = [(form.name, profile) for form in forms for profile in _profiles(form)]
    yield Serialization(RAW, RAW)
    yield from (Serialization("format", name, profile) for name, profile in ours)
    yield from (Serialization("format", form.name, _profiles(form)[0], packed=True) for form in forms)
    yield from (Serialization("library", library.name, slow=library.slow) for library in LIBRARIES)


def _profiles(form: catalog.Format) -> tuple[str | None, ...]:
    return form.choices("profile") or (None,)


def chosen(names: Iterable[str]) -> list[Serialization]:
    """Return the rows whose label starts with one of these names, or all rows without names; raw is always included."""
    known, names = list(serializations()), list(names)
    for name in names:
        if not any(row.label.startswith(name) for row in known):
            raise UsageError(f"no format is called {name!r}; allowed: {', '.join(row.label for row in known)}")
    return [row for row in known if row.kind == RAW or not names or row.label.startswith(tuple(names))]


def write_scene(path: Path, octree: SparseVoxelOctree) -> None:
    """Write the octree for the child processes."""
    with path.open("wb") as file:
        file.writelines(_module("svo.npz").encode(octree))


def encoding(row: list[Any], scene: str, target: str) -> Work:
    """The work of writing a file; called in a child process."""
    octree = _read_scene(scene)
    _read_all((octree.node_children, octree.node_data))  # loads the file into memory before the clock starts
    encode = _encoder(Serialization(*row))
    Path(target).unlink(missing_ok=True)

    def run() -> None:
        with open(target, "wb") as file:
            file.writelines(encode(octree))

    return Work(run, lambda _: {"size": Path(target).stat().st_size})


def decoding(row: list[Any], scene: str, target: str) -> Work:
    """The work of reading a file with all values; called in a child process."""
    octree = _read_scene(scene)
    decode = _decoder(Serialization(*row))

    def run() -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        arrays = decode(read_file(Path(target)), octree)
        _read_all(arrays)
        return arrays

    def check(arrays: tuple[npt.NDArray[Any], npt.NDArray[Any]]) -> dict[str, bool]:
        pairs = zip(arrays, (octree.node_children, octree.node_data), strict=True)
        return {"exact": all(a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in pairs)}

    return Work(run, check)


def _encoder(row: Serialization) -> Callable[[SparseVoxelOctree], Iterable[Any]]:
    if row.kind == RAW:
        return lambda octree: [octree.node_children.tobytes(), octree.node_data.tobytes()]
    if row.kind == "library":
        library = next(library for library in LIBRARIES if library.name == row.name)
        return lambda octree: [library.encode(octree)]
    encode = _module(row.name).encode
    options = {"profile": row.profile} if row.profile else {}
    if not row.packed:
        return lambda octree: encode(octree, **options)
    compress = catalog.load_compression().compress
    return lambda octree: compress(encode(octree, **options))


def _decoder(row: Serialization) -> Callable[[memoryview, SparseVoxelOctree], tuple[Any, Any]]:
    if row.kind == RAW:
        return _raw_decode
    if row.kind == "library":
        return next(library for library in LIBRARIES if library.name == row.name).decode
    module, decompress = _module(row.name), catalog.load_compression().decompress

    def decode(view: memoryview, _: SparseVoxelOctree) -> tuple[Any, Any]:
        content = decompress(view) if row.packed else view
        octree = module.decode(content)
        return octree.node_children, octree.node_data

    return decode


def _raw_decode(view: memoryview, octree: SparseVoxelOctree) -> tuple[Any, Any]:
    split = octree.node_children.nbytes
    return np.frombuffer(view[:split], np.int32), np.frombuffer(view[split:], octree.node_data.dtype)


def _read_all(arrays: Iterable[npt.NDArray[Any]]) -> None:
    """Read every value at the lowest possible cost, which is almost only the memory access."""
    for array in arrays:
        np.bitwise_xor.reduce(np.ascontiguousarray(array).reshape(-1).view(f"u{array.itemsize}"))


def _read_scene(path: str) -> SparseVoxelOctree:
    octree: SparseVoxelOctree = _module("svo.npz").decode(read_file(Path(path)))
    return octree


def _module(name: str) -> FileFormat:
    return catalog.format_named(name, "SparseVoxelOctree").load_module()


Results = dict[Serialization, list[Result]]
PACKAGES = ("numpy", "orjson", "pymongo", "zstandard", "protobuf", "flatbuffers", "pycapnp")
NOTES = [
    "encode: from arrays in memory to a written file. decode: until every value has been read. Median [min..max].",
    "x raw: ratio to `raw` (the bytes of both arrays) in the same run; for decode, ratio to the encode time of raw.",
    "peak: memory that the step added to its process, including pages of the mapped file.",
    "exact: every bit of both arrays is restored.",
    "report: lists of numbers, as in TR-24-01; bulk: one block of memory for each array. Rows with a library's name "
    "use it in the plain way, with the two arrays only; json.dumps and flatbuffers by element are measured once.",
    f"BinaryFormatter: {WITHDRAWN}.",
]

COLUMNS = ["format", "MB", "size x raw", "encode ms", "encode x raw", "peak MB"]
COLUMNS += ["decode ms", "decode x raw", "decode peak MB", "exact"]


def compare_formats(
    octree: SparseVoxelOctree, name: str, *, rounds: int, formats: Iterable[str], progress: Progress
) -> Report:
    """Measure every row and return the report; progress(text) surrounds each step. Raises UsageError for unknown
    names."""
    rows = chosen(formats)
    encodes: Results = {row: [] for row in rows}
    decodes: Results = {row: [] for row in rows}
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        scene = Path(folder) / "scene.svo.npz"
        write_scene(scene, octree)
        for turn in range(rounds + 1):
            for row in rows:
                if turn and encodes[row] and (row.slow or encodes[row][0].error):
                    continue  # measured once
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
    """Plot size against the time to write, with a point for each measured row."""
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
