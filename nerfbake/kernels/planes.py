"""Lloyd's rounds for clusters that are not points but planes: each follows its members' features.

y = x P_k,  x = (1, f)         P_k (4, p): the weighted least-squares fit to the members of cluster k
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.jit import compiled
from nerfbake.kernels.lloyd import PARTS, Cells

Array = npt.NDArray[np.float32]
Floats = npt.NDArray[np.float64]
f32 = np.float32

_FAR = 1e9
_CELLS = 1 << 11  # at a time, in nearest_clusters()


def nearest_clusters(cells: Cells, centres: Array, count: int) -> npt.NDArray[np.int32]:
    """(c, count) the clusters whose centres are closest to each cell's mean."""
    count = min(count, len(centres))
    found = np.empty((len(cells.mean), count), np.int32)
    squares = (centres * centres).sum(axis=1)
    for start in range(0, len(found), _CELLS):
        part = cells.mean[start : start + _CELLS]
        away = squares - 2 * (part @ centres.T)
        found[start : start + _CELLS] = np.argpartition(away, count - 1, axis=1)[:, :count]
    return found


def fit(points: Array, features: Array, weight: Floats, label: npt.NDArray[np.int32], K: int, flatness: float) -> Array:
    """(K, 4, p) the planes of K clusters; flatness pulls their slopes to 0, per unit of weight.

    A cluster without members gets a plane so far away that it stays without.
    """
    p = points.shape[1]
    moments = np.zeros((PARTS, K, 4, 4 + p))
    _moments(points, features, weight, label, moments)
    total = moments.sum(axis=0)
    left, right = total[..., :4], total[..., 4:]
    empty = left[:, 0, 0] == 0
    left[empty], right[empty, 0] = np.eye(4), _FAR
    pull = flatness * left[:, :1, :1] * np.diag([0.0, 1, 1, 1])
    planes: Array = np.linalg.solve(left + pull, right).astype(np.float32)
    return planes


def assign(
    points: Array, features: Array, cells: Cells, candidates: npt.NDArray[np.int32], planes: Array
) -> npt.NDArray[np.int32]:
    """(m,) which plane comes closest to each point, among its cell's candidates; the first of equals."""
    label = np.empty(len(points), np.int32)
    _assign(points, features, cells.start, candidates, planes, label)
    return label


@compiled(parallel=True)
def _moments(points: Array, features: Array, weight: Floats, label: npt.NDArray[np.int32], moments: Floats) -> None:
    m, p = points.shape
    for part in prange(len(moments)):
        x = np.ones(4)
        for i in range(m * part // len(moments), m * (part + 1) // len(moments)):
            total = moments[part, label[i]]
            for a in range(3):
                x[a + 1] = features[i, a]
            for a in range(4):
                scaled = weight[i] * x[a]
                for b in range(4):
                    total[a, b] += scaled * x[b]
                for t in range(p):
                    total[a, 4 + t] += scaled * points[i, t]


@compiled(parallel=True, fastmath=True)
def _assign(
    points: Array,
    features: Array,
    start: npt.NDArray[np.int64],
    candidates: npt.NDArray[np.int32],
    planes: Array,
    label: npt.NDArray[np.int32],
) -> None:
    p = points.shape[1]
    for c in prange(len(candidates)):
        for i in range(start[c], start[c + 1]):
            r, g, b = features[i, 0], features[i, 1], features[i, 2]
            best, which = f32(np.inf), np.int32(0)
            for q in range(candidates.shape[1]):
                k = candidates[c, q]
                plane = planes[k]
                square = f32(0)
                for t in range(p):
                    apart = points[i, t] - (plane[0, t] + r * plane[1, t] + g * plane[2, t] + b * plane[3, t])
                    square += apart * apart
                if square < best:
                    best, which = square, np.int32(k)
            label[i] = which
