"""Octahedral atlases in every method and size: error, time, memory, bytes; the K-means thesis' table 2 redone.

Each figure comes from a process of its own that has loaded its compiled kernels before the clock runs.

    bake     from the feature texture and the MLP in memory to written PNGs
    error    over every used texel and 100 directions; held out: in 617 other ones
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import nerfbake
from nerfbake import io
from nerfbake.bench.atlas.baking import RECIPES, Recipe, baking
from nerfbake.bench.atlas.clustering import CLUSTERINGS, clustering
from nerfbake.bench.environment import environment
from nerfbake.bench.measure import Result, Statistics, measure
from nerfbake.bench.plot import Mark, scatter
from nerfbake.bench.progress import Progress
from nerfbake.bench.report import Report, Table

PACKAGES = ("numpy", "numba", "pillow", "scikit-learn")

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
NOTES = [
    "MAE, MSE: of whole numbers 0..255, as 8-bit pictures hold them; float: before rounding. Bilinear lookup.",
    "peak: memory that the bake added to its process. GPU: maps with gutter, labels (1 byte to K = 256, else 2) and "
    "features (3 bytes), uncompressed. fetches: maps + per texel.",
    "thesis: its table 2, as published; a fault of its evaluation raised the errors, and the times are its machine's.",
    "inertia: mean squared distance to the clusters' means over all weighted colours, per channel and direction; "
    "scikit-learn is given the same identifiers and one start (n_init=1), fitted to what its name says.",
]


def compare_atlases(folder: str, *, rounds: int, progress: Progress) -> Report:
    """Measures every row of a stage-1 folder's first cascade, and scikit-learn on the same identifiers."""
    results: dict[Recipe, list[Result]] = {recipe: [] for recipe in RECIPES}
    for turn in range(rounds):
        for recipe in RECIPES:
            with progress(f"{recipe.label}: round {turn + 1} of {rounds}"):
                results[recipe].append(measure(baking, folder=folder, recipe=recipe))
    clusterings = []
    for name, K in CLUSTERINGS:
        with progress(f"{name}, K={K}"):
            clusterings.append((name, K, measure(clustering, folder=folder, name=name, K=K)))
    field = io.load_folder(folder, nerfbake.Stage1).fields[0]
    head = {"scene": f"{Path(folder).name}: {field}", "rounds": str(rounds), **environment(*PACKAGES)}
    tables = [
        Table("Atlases", COLUMNS, [_cells(recipe, found) for recipe, found in results.items()]),
        Table("Clusterings", ["clustering", "K", "s", "peak MB", "inertia"], [_clustered(*row) for row in clusterings]),
    ]
    return Report("Octahedral atlases of a specular MLP", head, tables, NOTES)


def chart_atlases(report: Report, suffix: str) -> bytes:
    """Error against bytes, a point for each row that was measured."""
    rows = [dict(zip(COLUMNS, row, strict=True)) for row in report.tables[0].rows]
    marks = [
        Mark(row["atlas"], row["GPU MB"], row["float MSE"], row["atlas"].split()[0])
        for row in rows
        if row["GPU MB"] is not None
    ]
    title = "Specular MLP as octahedral atlases: error against size"
    return scatter(marks, title=title, x="maps and per-texel data, MB uncompressed", y="MSE, of 255", suffix=suffix)


def _cells(recipe: Recipe, found: list[Result]) -> list[Any]:
    if error := next((result.error for result in found if result.error), ""):
        return [f"{recipe.label}: {error}", *[None] * (len(COLUMNS) - 1)]

    def over_rounds(name: str) -> Statistics:
        return Statistics.of([result.facts[name] for result in found])

    facts = found[0].facts
    errors = [facts[name] for name in ("mae", "mse", "mae_float", "mse_float", "held_out")]
    steps = ("identify", "cluster", "write", "metric")
    times = [Statistics.of([result.seconds for result in found]), *map(over_rounds, steps)]
    sizes = [max(result.peak for result in found) / 1e6, facts["png"] / 1e6, facts["gpu"] / 1e6]
    thesis = THESIS.get(recipe.size, (None,) * 3) if recipe.method == "kmeans" else (None,) * 3
    return [recipe.label, *errors, *times, *sizes, FETCHES[recipe.method], *thesis]


def _clustered(name: str, K: int, result: Result) -> list[Any]:
    if result.error:
        return [f"{name}: {result.error}", K, None, None, None]
    return [name, K, result.seconds, result.peak / 1e6, result.facts["inertia"]]
