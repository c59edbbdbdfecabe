"""The octree in every format and profile: size, time, memory, exactness, on one's own scene and machine.

The comparison of TR-24-01's appendix B (tables 4 and 5), with today's libraries. Each figure comes from a process of
its own; the formats take turns, round by round, after a round that does not count.

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
from nerfbake.bench.libraries import LIBRARIES
from nerfbake.bench.measure import Result, Spread, Work, measure
from nerfbake.bench.plot import Point, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.errors import UsageError
from nerfbake.io.sources import read_file
from nerfbake.scene.octree import SparseVoxelOctree

RAW = "raw"
PACKAGES = ("numpy", "orjson", "pymongo", "zstandard", "protobuf", "flatbuffers", "pycapnp")

# TR-24-01, tables 4 and 5: LEGO at 128^3, 420k nodes x 49 float32, on a free Colab CPU.
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


class Contender(NamedTuple):
    """One row. kind: raw, format or library; name and profile say which; packed with zstd or not."""

    kind: str
    name: str
    profile: str | None = None
    packed: bool = False
    slow: bool = False

    @property
    def label(self) -> str:
        return f"{self.name}{catalog.COMPRESSED if self.packed else ''}{f' {self.profile}' if self.profile else ''}"


def contenders() -> Iterator[Contender]:
    """Every row that there is: the floor, our formats in each profile, those with .zst, then the libraries' own use."""
    forms = catalog.formats_of("SparseVoxelOctree")
    ours = [(form.name, profile) for form in forms for profile in form.profiles or (None,)]
    yield Contender(RAW, RAW)
    yield from (Contender("format", name, profile) for name, profile in ours)
    yield from (Contender("format", form.name, (form.profiles or (None,))[0], packed=True) for form in forms)
    yield from (Contender("library", library.name, slow=library.slow) for library in LIBRARIES)


def chosen(names: Iterable[str]) -> list[Contender]:
    """The rows whose label starts with one of these names, all if there is none, and always the floor."""
    known, names = list(contenders()), list(names)
    for name in names:
        if not any(contender.label.startswith(name) for contender in known):
            raise UsageError(f"no format is called {name!r}; allowed: {', '.join(c.label for c in known)}")
    return [c for c in known if c.kind == RAW or not names or c.label.startswith(tuple(names))]


def compare(octree: SparseVoxelOctree, name: str, *, rounds: int, formats: Iterable[str], progress: Progress) -> Report:
    """Measures every contender and reports; progress(text) surrounds each step. Raises UsageError for unknown names."""
    rows = chosen(formats)
    encodes: dict[Contender, list[Result]] = {contender: [] for contender in rows}
    decodes: dict[Contender, list[Result]] = {contender: [] for contender in rows}
    with TemporaryDirectory(prefix="nerfbake-bench-") as folder:
        scene = Path(folder) / "scene.svo.npz"
        with scene.open("wb") as file:
            file.writelines(_module("svo.npz").encode(octree))
        for turn in range(rounds + 1):
            for contender in rows:
                if turn and encodes[contender] and (contender.slow or encodes[contender][0].error):
                    continue  # one look is enough
                if not turn and contender.slow:
                    continue
                arguments = {"contender": contender, "scene": str(scene), "target": str(Path(folder) / "target")}
                with progress(f"{contender.label}: {f'round {turn} of {rounds}' if turn else 'warming up'}"):
                    encoded = measure(encoding, **arguments)
                    decoded = encoded if encoded.error else measure(decoding, **arguments)
                if turn or encoded.error:
                    encodes[contender].append(encoded)
                    decodes[contender].append(decoded)
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


def chart(report: Report, suffix: str) -> bytes:
    """Size against the time to write, a point for each row that was measured."""
    points = []
    for row in report.tables[0].rows:
        cells = dict(zip(COLUMNS, row, strict=True))
        if cells["MB"] is not None:
            points.append(Point(cells["format"], cells["encode ms"].median, cells["MB"], _group(cells["format"])))
    scene = report.head["scene"]
    return scatter(points, title=f"Writing an octree: {scene}", x="encode, ms (median)", y="file, MB", suffix=suffix)


def _group(label: str) -> str:
    contender = next(c for c in contenders() if c.label == label)
    return {RAW: "floor", "library": "the libraries' own use"}.get(
        contender.kind, "nerfbake, compressed" if contender.packed else "nerfbake"
    )


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


def _figures(
    rows: list[Contender], encodes: dict[Contender, list[Result]], decodes: dict[Contender, list[Result]], raw: int
) -> Table:
    floor = Spread.of([result.seconds for result in encodes[rows[0]]]).median
    cells: list[list[Any]] = []
    for row in rows:
        encoded, decoded = encodes[row], decodes[row]
        if error := next((result.error for result in encoded + decoded if result.error), ""):
            cells.append([f"{row.label}: {error}", *[None] * (len(COLUMNS) - 1)])
            continue
        size = encoded[0].facts["size"]
        times = [Spread.of([1e3 * result.seconds for result in results]) for results in (encoded, decoded)]
        peaks = [max(result.peak for result in results) / 1e6 for results in (encoded, decoded)]
        exact = all(result.facts["exact"] for result in decoded)
        ratios = [time.median / 1e3 / floor for time in times]
        cells.append(
            [row.label, size / 1e6, size / raw, times[0], ratios[0], peaks[0], times[1], ratios[1], peaks[1], exact]
        )
    return Table("Formats", COLUMNS, cells)


def encoding(contender: list[Any], scene: str, target: str) -> Work:
    """The work of writing a file; in a process of its own."""
    octree = _scene(scene)
    _read_all((octree.node_children, octree.node_data))  # from the disk into memory, before the clock runs
    encode = _encoder(Contender(*contender))
    Path(target).unlink(missing_ok=True)

    def run() -> None:
        with open(target, "wb") as file:
            file.writelines(encode(octree))

    return Work(run, lambda _: {"size": Path(target).stat().st_size})


def decoding(contender: list[Any], scene: str, target: str) -> Work:
    """The work of reading a file until every value has been seen; in a process of its own."""
    octree = _scene(scene)
    decode = _decoder(Contender(*contender))

    def run() -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
        arrays = decode(read_file(Path(target)), octree)
        _read_all(arrays)
        return arrays

    def check(arrays: tuple[npt.NDArray[Any], npt.NDArray[Any]]) -> dict[str, bool]:
        pairs = zip(arrays, (octree.node_children, octree.node_data), strict=True)
        return {"exact": all(a.dtype == b.dtype and a.tobytes() == b.tobytes() for a, b in pairs)}

    return Work(run, check)


def _encoder(contender: Contender) -> Callable[[SparseVoxelOctree], Iterable[Any]]:
    if contender.kind == RAW:
        return lambda octree: [octree.node_children.tobytes(), octree.node_data.tobytes()]
    if contender.kind == "library":
        library = next(library for library in LIBRARIES if library.name == contender.name)
        return lambda octree: [library.encode(octree)]
    encode = _module(contender.name).encode
    options = {"profile": contender.profile} if contender.profile else {}
    if not contender.packed:
        return lambda octree: encode(octree, **options)
    compress = catalog.load_compression().compress
    return lambda octree: compress(encode(octree, **options))


def _decoder(contender: Contender) -> Callable[[memoryview, SparseVoxelOctree], tuple[Any, Any]]:
    if contender.kind == RAW:
        return _raw_decode
    if contender.kind == "library":
        return next(library for library in LIBRARIES if library.name == contender.name).decode
    module, decompress = _module(contender.name), catalog.load_compression().decompress

    def decode(view: memoryview, _: SparseVoxelOctree) -> tuple[Any, Any]:
        content = decompress(view) if contender.packed else view
        octree = module.decode(content)
        return octree.node_children, octree.node_data

    return decode


def _raw_decode(view: memoryview, octree: SparseVoxelOctree) -> tuple[Any, Any]:
    split = octree.node_children.nbytes
    return np.frombuffer(view[:split], np.int32), np.frombuffer(view[split:], octree.node_data.dtype)


def _read_all(arrays: Iterable[npt.NDArray[Any]]) -> None:
    """Reads every value, as cheaply as can be: what it costs is nearly all the memory's."""
    for array in arrays:
        np.bitwise_xor.reduce(np.ascontiguousarray(array).reshape(-1).view(f"u{array.itemsize}"))


def _scene(path: str) -> SparseVoxelOctree:
    octree: SparseVoxelOctree = _module("svo.npz").decode(read_file(Path(path)))
    return octree


def _module(name: str) -> Any:
    return catalog.format_named(name, "SparseVoxelOctree").load_module()
