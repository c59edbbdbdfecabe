"""Lloyd's algorithm for clusters that are planes over their members' features.

y = x P_k,  x = (1, f)         P_k (4, p): the weighted least-squares fit to the members of cluster k
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Singles, f32
from nerfbake.kernels.cluster.lloyd import PARTS, PointCells, squares
from nerfbake.kernels.jit import compiled, part_of
from nerfbake.kernels.maths.linear import solve_each
from nerfbake.kernels.parallel import on_every_core

_FAR = 1e9


def nearest_clusters(cells: PointCells, centres: Singles, count: int) -> npt.NDArray[np.int32]:
    """(c, count) the clusters whose centres are closest to each cell's mean, in order; of equal ones the first."""
    found = np.empty((len(cells.mean), min(count, len(centres))), np.int32)
    _nearest_clusters(cells.mean, np.ascontiguousarray(centres.T), found)
    return found


def fit(
    points: Singles, features: Singles, weight: Floats, label: npt.NDArray[np.int32], K: int, flatness: float
) -> Singles:
    """Fit the planes (K, 4, p) of K clusters. flatness pulls their slopes to 0, per unit of weight.

    A cluster without members gets a plane so far away that it remains without members.
    """
    p = points.shape[1]
    moments = np.zeros((PARTS, K, 4, 4 + p))
    _moments(points, features, weight, label, moments)
    total = moments.sum(axis=0)
    left, right = total[..., :4], total[..., 4:]
    empty = left[:, 0, 0] == 0
    left[empty], right[empty, 0] = np.eye(4), _FAR
    pull = flatness * left[:, :1, :1] * np.diag([0.0, 1, 1, 1])
    return solve_each(left + pull, right).astype(np.float32)


def nearest_planes(
    points: Singles, features: Singles, cells: PointCells, candidates: npt.NDArray[np.int32], planes: Singles
) -> npt.NDArray[np.int32]:
    """(m,) the plane closest to each point, among the candidates of its cell; the first of equally close ones."""
    label = np.empty(len(points), np.int32)
    _nearest_planes(points, features, cells.start, candidates, planes, label)
    return label


@on_every_core
@compiled()
def _moments(
    core: int,
    cores: int,
    points: Singles,
    features: Singles,
    weight: Floats,
    label: npt.NDArray[np.int32],
    moments: Floats,
) -> None:
    m, p = points.shape
    for part in range(core, len(moments), cores):
        x = np.ones(4)
        begin, end = part_of(m, part, len(moments))
        for i in range(begin, end):
            total = moments[part, label[i]]
            for a in range(3):
                x[a + 1] = features[i, a]
            for a in range(4):
                scaled = weight[i] * x[a]
                for b in range(4):
                    total[a, b] += scaled * x[b]
                for t in range(p):
                    total[a, 4 + t] += scaled * points[i, t]


@on_every_core
@compiled()
def _nearest_clusters(core: int, cores: int, mean: Singles, across: Singles, found: npt.NDArray[np.int32]) -> None:
    """across (p, K): the centres, dimension by dimension."""
    K, count = across.shape[1], found.shape[1]
    for c in range(core, len(mean), cores):
        away = np.empty(K, np.float32)
        squares(mean[c], across, away)
        own, held = found[c], 0
        for k in range(K):
            if held == count and not away[k] < away[own[count - 1]]:
                continue
            held = min(held + 1, count)
            at = held - 1
            while at > 0 and away[k] < away[own[at - 1]]:
                own[at] = own[at - 1]
                at -= 1
            own[at] = k


@on_every_core
@compiled()
def _nearest_planes(
    core: int,
    cores: int,
    points: Singles,
    features: Singles,
    start: npt.NDArray[np.int64],
    candidates: npt.NDArray[np.int32],
    planes: Singles,
    label: npt.NDArray[np.int32],
) -> None:
    p, count = points.shape[1], candidates.shape[1]
    for c in range(core, len(candidates), cores):
        # The candidates' planes, dimension by dimension: a vector register contains several of them.
        near, away = np.empty((p, 4, count), np.float32), np.empty(count, np.float32)
        for q in range(count):
            for a in range(4):
                for t in range(p):
                    near[t, a, q] = planes[candidates[c, q], a, t]
        for i in range(start[c], start[c + 1]):
            r, g, b = features[i, 0], features[i, 1], features[i, 2]
            for q in range(count):
                away[q] = 0
            for t in range(p):
                for q in range(count):
                    shown = (near[t, 0, q] + r * near[t, 1, q]) + (g * near[t, 2, q] + b * near[t, 3, q])
                    apart = points[i, t] - shown
                    away[q] += apart * apart
            best, which = f32(np.inf), np.int32(0)
            for q in range(count):
                if away[q] < best:
                    best, which = away[q], candidates[c, q]
            label[i] = which
