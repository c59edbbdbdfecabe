"""Octahedral atlases in every method and size: error, time, memory, bytes; the K-means thesis' table 2 redone.

Each figure comes from a process of its own that has loaded its compiled kernels before the clock runs.

    bake     from the feature texture and the MLP in memory to written PNGs
    error    over every used texel and 100 directions; held out: in 617 other ones
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

import nerfbake
from nerfbake import io
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result, Spread, Work, measure
from nerfbake.bench.plot import Point, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.stages.specular_to_identifiers import Identifiers

PACKAGES = ("numpy", "numba", "pillow", "scikit-learn")


class Row(NamedTuple):
    """A method at a size: clusters, or nodes along an axis of the grid."""

    method: str
    size: int
    map_size: int = 64

    @property
    def label(self) -> str:
        count = f"{self.size}^3" if self.method == "grid" else f"K={self.size}"
        return f"{self.method} {count}" + ("" if self.map_size == 64 else f", {self.map_size}x{self.map_size}")


ROWS = [Row("kmeans", K) for K in (1, 4, 16, 64, 256, 1024, 2048)]
ROWS += [Row("affine", K) for K in (4, 16, 64, 256)]
ROWS += [Row("grid", 5), Row("grid", 7), Row("grid", 13, 32)]

# The thesis' table 2: MAE, MSE as published, and seconds, on the scene of its own.
THESIS: dict[int, tuple[float, float, int]] = {
    1: (12.933, 609.7, 839),
    4: (11.868, 476.4, 854),
    16: (11.151, 409.2, 1176),
    64: (10.789, 379.2, 1928),
    256: (10.637, 367.1, 4723),
    1024: (10.587, 362.2, 15289),
    2048: (10.578, 361.1, 34509),
}
COLUMNS = ["atlas", "MAE", "MSE", "float MAE", "float MSE", "held-out MAE", "bake s", "identify s", "cluster s"]
COLUMNS += ["write s", "metric s", "peak MB", "PNG MB", "GPU MB", "fetches", "thesis MAE", "thesis MSE", "thesis s"]
FETCHES = {"kmeans": "1+1", "affine": "4+2", "grid": "4+1"}
CLUSTERINGS = ["nerfbake", "MiniBatchKMeans", "KMeans on 100,000", "KMeans"]  # the slowest last
CONTENDERS = [(name, K) for K in (64, 256, 2048) for name in CLUSTERINGS[: {64: 4, 256: 3, 2048: 2}[K]]]
NOTES = [
    "MAE, MSE: of whole numbers 0..255, as 8-bit pictures hold them; float: before rounding. Bilinear lookup.",
    "peak: memory that the bake added to its process. GPU: maps with gutter, labels (1 byte to K = 256, else 2) and "
    "features (3 bytes), uncompressed. fetches: maps + per texel.",
    "thesis: its table 2, as published; a fault of its evaluation raised the errors, and the times are its machine's.",
    "inertia: mean squared distance to the clusters' means over all weighted colours, per channel and direction; "
    "scikit-learn is given the same identifiers and one start (n_init=1), fitted to what its name says.",
]


def compare(folder: str, *, rounds: int, progress: Progress) -> Report:
    """Measures every row of a stage-1 folder's first cascade, and scikit-learn on the same identifiers."""
    results: dict[Row, list[Result]] = {row: [] for row in ROWS}
    for turn in range(rounds):
        for row in ROWS:
            with progress(f"{row.label}: round {turn + 1} of {rounds}"):
                results[row].append(measure(baking, folder=folder, row=row))
    clusterings = []
    for name, K in CONTENDERS:
        with progress(f"{name}, K={K}"):
            clusterings.append((name, K, measure(clustering, folder=folder, name=name, K=K)))
    field = io.load_folder(folder, nerfbake.Stage1).fields[0]
    head = {"scene": f"{Path(folder).name}: {field}", "rounds": str(rounds), **environment(*PACKAGES)}
    tables = [
        Table("Atlases", COLUMNS, [_cells(row, found) for row, found in results.items()]),
        Table("Clusterings", ["clustering", "K", "s", "peak MB", "inertia"], [_clustered(*row) for row in clusterings]),
    ]
    return Report("Octahedral atlases of a specular MLP", head, tables, NOTES)


def chart(report: Report, suffix: str) -> bytes:
    """Error against bytes, a point for each row that was measured."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    points = [
        Point(row["atlas"], row["GPU MB"], row["float MSE"], row["atlas"].split()[0])
        for row in rows
        if row["GPU MB"] is not None
    ]
    title = "Specular MLP as octahedral atlases: error against size"
    return scatter(points, title=title, x="maps and per-texel data, MB uncompressed", y="MSE, of 255", suffix=suffix)


def baking(folder: str, row: list[Any]) -> Work:
    """The work of baking one row and writing it; in a process of its own."""
    method, size, map_size = row
    field = io.load_folder(folder, nerfbake.Stage1).fields[0]
    options = {"method": method, "map_size": map_size} | ({"nodes": size} if method == "grid" else {"clusters": size})
    corner = np.s_[:16, :16]
    small = replace(field, features=field.features[corner].copy(), used=np.ones((16, 16), bool))
    warm = nerfbake.bake_atlas(small, **{**options, "clusters": 1, "nodes": 2})
    directions = fibonacci(100)
    nerfbake.measure_atlas_error(warm, small, directions=directions)

    def run() -> dict[str, Any]:
        atlas = nerfbake.bake_atlas(field, **options)
        with TemporaryDirectory(prefix="nerfbake-bench-") as target:
            start = time.perf_counter()
            sizes = io.save_folder(target, nerfbake.BakedAtlas((atlas,), (None,), {}, {}), force=True)
            return {"atlas": atlas, "sizes": sizes, "write": time.perf_counter() - start}

    def check(found: dict[str, Any]) -> dict[str, Any]:
        atlas = found["atlas"]
        error, metric = _timed(lambda: nerfbake.measure_atlas_error(atlas, field, directions=directions))
        held_out = nerfbake.measure_atlas_error(atlas, field, directions=fibonacci(617))
        identifiers, identify = _timed(lambda: nerfbake.identify_colours(field, directions=directions))
        seconds = 0.0
        if method != "grid":
            find = nerfbake.cluster_planes if method == "affine" else nerfbake.cluster_identifiers
            _, seconds = _timed(lambda: find(identifiers, clusters=size))
        texel = (2 if atlas.K > 256 else 1) * (method != "grid") + 3 * (method != "kmeans")
        return {
            **error._asdict(),
            "held_out": held_out.mae,
            "identify": identify,
            "cluster": seconds,
            "write": found["write"],
            "metric": metric,
            "png": sum(size for name, size in found["sizes"].items() if name.endswith(".png")),
            "gpu": atlas.image.size + texel * atlas.labels.size,
        }

    return Work(run, check)


def clustering(folder: str, name: str, K: int) -> Work:
    """The work of clustering the identifiers, one way or another; in a process of its own."""
    field = io.load_folder(folder, nerfbake.Stage1).fields[0]
    identifiers = nerfbake.identify_colours(field, directions=fibonacci(100))
    points, counts = identifiers.points, identifiers.counts
    every = max(1, len(points) // 100_000)
    some = slice(None, None, every) if name == "KMeans on 100,000" else slice(None)
    if name == "nerfbake":
        nerfbake.cluster_identifiers(identifiers, clusters=1)
        return Work(
            lambda: nerfbake.cluster_identifiers(identifiers, clusters=K).labels,
            lambda labels: _inertia(identifiers, labels),
        )
    from sklearn.cluster import KMeans, MiniBatchKMeans

    kind = MiniBatchKMeans if name == "MiniBatchKMeans" else KMeans
    model = kind(K, n_init=1, random_state=0)

    def run() -> npt.NDArray[np.int32]:
        labels: npt.NDArray[np.int32] = model.fit(points[some], sample_weight=counts[some]).predict(points)
        return labels

    return Work(run, lambda labels: _inertia(identifiers, labels))


def _inertia(identifiers: Identifiers, labels: npt.NDArray[np.int32]) -> dict[str, float]:
    points, counts = identifiers.points.astype(np.float64), identifiers.counts
    weight = np.bincount(labels, counts)
    explained = 0.0
    for component in points.T:
        explained += float((np.bincount(labels, counts * component) ** 2 / np.maximum(weight, 1)).sum())
    total = float(counts @ (points**2).sum(axis=1))
    return {"inertia": (total - explained) / counts.sum() / 300}


def _timed(work: Callable[[], Any]) -> tuple[Any, float]:
    start = time.perf_counter()
    return work(), time.perf_counter() - start


def _cells(row: Row, found: list[Result]) -> list[Any]:
    if error := next((result.error for result in found if result.error), ""):
        return [f"{row.label}: {error}", *[None] * (len(COLUMNS) - 1)]

    def spread(name: str) -> Spread:
        return Spread.of([result.facts[name] for result in found])

    facts = found[0].facts
    errors = [facts[name] for name in ("mae", "mse", "mae_float", "mse_float", "held_out")]
    times = [Spread.of([result.seconds for result in found]), *map(spread, ("identify", "cluster", "write", "metric"))]
    sizes = [max(result.peak for result in found) / 1e6, facts["png"] / 1e6, facts["gpu"] / 1e6]
    thesis = THESIS.get(row.size, (None,) * 3) if row.method == "kmeans" else (None,) * 3
    return [row.label, *errors, *times, *sizes, FETCHES[row.method], *thesis]


def _clustered(name: str, K: int, result: Result) -> list[Any]:
    if result.error:
        return [f"{name}: {result.error}", K, None, None, None]
    return [name, K, result.seconds, result.peak / 1e6, result.facts["inertia"]]
