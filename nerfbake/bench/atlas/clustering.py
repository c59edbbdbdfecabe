"""Clusterings of the same identifiers: ours beside scikit-learn's."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

import nerfbake
from nerfbake import io
from nerfbake.bench.measure import Work
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.stages.specular_to_identifiers import Identifiers

WAYS = ["nerfbake", "MiniBatchKMeans", "KMeans on 100,000", "KMeans"]  # the slowest last
CLUSTERINGS = [(name, K) for K in (64, 256, 2048) for name in WAYS[: {64: 4, 256: 3, 2048: 2}[K]]]


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
