"""Benchmark of octahedral atlases (`bench atlas`): error, time, memory and bytes of every method and size.

It repeats table 2 of the K-means thesis, and compares nerfbake's clustering with scikit-learn's on the same
identifiers. Each figure comes from a separate process that has loaded its compiled kernels before the clock starts.

    bake     from the feature texture and the MLP in memory to written PNGs
    error    over every used texel and 100 directions; held out: in 617 other ones
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import io
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Progress, Result, Statistics, Work, measure, seconds_of
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.report import Report, Table
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.specular_to_atlas import bake_atlas
from nerfbake.stages.specular_to_clusters import Identifiers, cluster_identifiers, cluster_planes, identify_colours
from nerfbake.stages.stage1_to_atlas import measure_atlas_error

WAYS = ["nerfbake", "MiniBatchKMeans", "KMeans on 100,000", "KMeans"]  # the slowest last
CLUSTERINGS = [(name, K) for K in (64, 256, 2048) for name in WAYS[: {64: 4, 256: 3, 2048: 2}[K]]]


def clustering(folder: str, name: str, K: int) -> Work:
    """The work of clustering the identifiers with the algorithm `name`; called in a child process."""
    field = io.load_folder(folder, Stage1).fields[0]
    identifiers = identify_colours(field, directions=fibonacci(100))
    points, counts = identifiers.points, identifiers.counts
    every = max(1, len(points) // 100_000)
    some = slice(None, None, every) if name == "KMeans on 100,000" else slice(None)
    if name == "nerfbake":
        cluster_identifiers(identifiers, clusters=1)
        return Work(
            lambda: cluster_identifiers(identifiers, clusters=K).labels,
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


class AtlasMethod(NamedTuple):
    """A method with its size: the number of clusters, or of grid nodes along an axis."""

    method: str
    size: int
    map_size: int = 64

    @property
    def label(self) -> str:
        count = f"{self.size}^3" if self.method == "grid" else f"K={self.size}"
        return f"{self.method} {count}" + ("" if self.map_size == 64 else f", {self.map_size}x{self.map_size}")


VARIANTS = [AtlasMethod("kmeans", K) for K in (1, 4, 16, 64, 256, 1024, 2048)]
VARIANTS += [AtlasMethod("affine", K) for K in (4, 16, 64, 256)]
VARIANTS += [AtlasMethod("grid", 5), AtlasMethod("grid", 7), AtlasMethod("grid", 13, 32)]


def baking(folder: str, variant: list[Any]) -> Work:
    """The work of baking and writing the atlas of one variant; called in a child process."""
    method, size, map_size = variant
    field = io.load_folder(folder, Stage1).fields[0]
    options = {"method": method, "map_size": map_size} | ({"nodes": size} if method == "grid" else {"clusters": size})
    corner = np.s_[:16, :16]
    small = replace(field, features=field.features[corner].copy(), used=np.ones((16, 16), bool))
    warm = bake_atlas(small, **{**options, "clusters": 1, "nodes": 2})
    directions = fibonacci(100)
    measure_atlas_error(warm, small, directions=directions)

    def run() -> dict[str, Any]:
        atlas = bake_atlas(field, **options)
        with TemporaryDirectory(prefix="nerfbake-bench-") as target:
            baked = BakedAtlas((atlas,), (None,), {}, {})
            sizes, seconds = seconds_of(lambda: io.save_folder(target, baked, force=True))
            return {"atlas": atlas, "sizes": sizes, "write": seconds}

    def check(found: dict[str, Any]) -> dict[str, Any]:
        atlas = found["atlas"]
        error, metric = seconds_of(lambda: measure_atlas_error(atlas, field, directions=directions))
        held_out = measure_atlas_error(atlas, field, directions=fibonacci(617))
        identifiers, identify = seconds_of(lambda: identify_colours(field, directions=directions))
        seconds = 0.0
        if method != "grid":
            find = cluster_planes if method == "affine" else cluster_identifiers
            _, seconds = seconds_of(lambda: find(identifiers, clusters=size))
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


PACKAGES = ("numpy", "numba", "pillow", "scikit-learn")

# Table 2 of the thesis: published MAE, MSE and seconds, for the scene of the thesis.
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
NOTES = [
    "MAE, MSE: errors of 8-bit values 0..255; float: errors before rounding. Bilinear lookup.",
    "peak: memory that the bake added to its process. GPU: maps with gutter, labels (1 byte up to K = 256, else 2) and "
    "features (3 bytes), uncompressed. fetches: from the maps + per texel.",
    "thesis: table 2 as published. A fault in its evaluation raised the errors; the times are from another machine.",
    "inertia: mean squared distance to the cluster means over all weighted colours, per channel and direction. "
    "scikit-learn gets the same identifiers (as a sample if its name has a number) and one initialisation (n_init=1).",
]


def compare_atlases(folder: str, *, rounds: int, progress: Progress) -> Report:
    """Measure every method on the first cascade of a stage-1 folder, and scikit-learn on the same identifiers."""
    results: dict[AtlasMethod, list[Result]] = {variant: [] for variant in VARIANTS}
    for turn in range(rounds):
        for variant in VARIANTS:
            with progress(f"{variant.label}: round {turn + 1} of {rounds}"):
                results[variant].append(measure(baking, folder=folder, variant=variant))
    clusterings = []
    for name, K in CLUSTERINGS:
        with progress(f"{name}, K={K}"):
            clusterings.append((name, K, measure(clustering, folder=folder, name=name, K=K)))
    field = io.load_folder(folder, Stage1).fields[0]
    head = {"scene": f"{Path(folder).name}: {field}", "rounds": str(rounds), **environment(*PACKAGES)}
    tables = [
        Table("Atlases", COLUMNS, [_cells(variant, found) for variant, found in results.items()]),
        Table("Clusterings", ["clustering", "K", "s", "peak MB", "inertia"], [_clustered(*row) for row in clusterings]),
    ]
    return Report("Octahedral atlases of a specular MLP", head, tables, NOTES)


def chart_atlases(report: Report, suffix: str) -> bytes:
    """Plot error against bytes, with a point for each measured row."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    marks = [
        Mark(row["atlas"], row["GPU MB"], row["float MSE"], row["atlas"].split()[0])
        for row in rows
        if row["GPU MB"] is not None
    ]
    title = "Specular MLP as octahedral atlases: error against size"
    return scatter(marks, title=title, x="maps and per-texel data, MB uncompressed", y="MSE, of 255", suffix=suffix)


def _cells(variant: AtlasMethod, found: list[Result]) -> list[Any]:
    if error := next((result.error for result in found if result.error), ""):
        return [f"{variant.label}: {error}", *[None] * (len(COLUMNS) - 1)]

    def over_rounds(name: str) -> Statistics:
        return Statistics.of([result.facts[name] for result in found])

    facts = found[0].facts
    errors = [facts[name] for name in ("mae", "mse", "mae_float", "mse_float", "held_out")]
    steps = ("identify", "cluster", "write", "metric")
    times = [Statistics.of([result.seconds for result in found]), *map(over_rounds, steps)]
    sizes = [max(result.peak for result in found) / 1e6, facts["png"] / 1e6, facts["gpu"] / 1e6]
    thesis = THESIS.get(variant.size, (None,) * 3) if variant.method == "kmeans" else (None,) * 3
    return [variant.label, *errors, *times, *sizes, FETCHES[variant.method], *thesis]


def _clustered(name: str, K: int, result: Result) -> list[Any]:
    if result.error:
        return [f"{name}: {result.error}", K, None, None, None]
    return [name, K, result.seconds, result.peak / 1e6, result.facts["inertia"]]
