"""Weighted k-means with exact rounds that examine only few centres for each point: the points are sorted into cells.

A centre can be the nearest to a point only if its distance to the mean of the point's cell is at most nearest + 2
radii, where nearest is the distance from the mean to its closest centre (the triangle inequality, twice). With cells of
5-bit colour and 2048 centres, 34 centres remain on average. Sums are kept in a fixed number of parts and added in
order, so the number of threads does not change them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints, Singles, f32
from nerfbake.kernels.jit import compiled, part_of
from nerfbake.kernels.parallel import on_every_core

PARTS = 16
TRIALS = 4  # draws, of which the best becomes a new seed: 3 % less inertia than one draw


class PointCells(NamedTuple):
    """Runs of points that lie close together."""

    start: Ints  # (c + 1,) cell c contains points start[c] to start[c + 1]
    mean: Singles  # (c, p)
    radius: Singles  # (c,) largest distance of a point to the mean


class Groups(NamedTuple):
    """The weighted mean of the points of each cell, and their total weight."""

    mean: Singles
    weight: npt.NDArray[np.float64]


def bound_cells(points: Singles, start: Ints) -> PointCells:
    """Bound cells of (m, p) points; start: where each cell starts, the end last."""
    mean = group(points, np.ones(len(points)), start).mean
    radius = np.empty(len(mean), np.float32)
    _radii(points, start, mean, radius)
    return PointCells(start, mean, radius)


def group(points: Singles, weight: npt.NDArray[np.float64], start: Ints) -> Groups:
    """The weighted means (c, p) and total weights (c,) of the cells."""
    total = np.zeros((len(start) - 1, points.shape[1] + 1))
    _cell_sums(points, weight, start, total)
    return Groups((total[:, :-1] / total[:, -1:]).astype(np.float32), total[:, -1])


def seed(points: Singles, weight: npt.NDArray[np.float64], K: int, random: np.random.Generator) -> Singles:
    """Choose K of the points, far apart, as (K, p): greedy k-means++ (Arthur and Vassilvitskii, 2007), weighted."""
    across, weight, draws = np.ascontiguousarray(points.T), np.ascontiguousarray(weight), random.random((K, TRIALS))
    chosen, nearest = np.empty(K, np.int64), np.full(len(points), np.inf, np.float32)
    attempts, inertia = np.empty((TRIALS, len(points)), np.float32), np.empty(TRIALS)
    for k in range(K):
        reach = np.cumsum(nearest * weight if k else weight)
        drawn = np.minimum(np.searchsorted(reach, draws[k] * reach[-1], side="right"), len(points) - 1)
        _attempt(across, weight, drawn, nearest, attempts, inertia)
        best = np.argmin(inertia)
        chosen[k] = drawn[best]
        nearest[:] = attempts[best]
    return points[chosen]


def nearest_centres(points: Singles, cells: PointCells, centres: Singles) -> tuple[npt.NDArray[np.int32], Singles]:
    """(m,) the nearest centre of each point, the first of equally near ones, and its squared distance."""
    label, distance = np.empty(len(points), np.int32), np.empty(len(points), np.float32)
    _nearest_centres(points, *cells, np.ascontiguousarray(centres.T), label, distance)
    return label, distance


def move(points: Singles, weight: npt.NDArray[np.float64], label: npt.NDArray[np.int32], centres: Singles) -> Singles:
    """(K, p) the weighted mean of each centre's points; a centre without points stays."""
    parts = np.zeros((PARTS, len(centres), points.shape[1] + 1))
    _label_sums(points, weight, label, parts)
    total = parts.sum(axis=0)
    held = total[:, -1] > 0
    moved = centres.copy()
    moved[held] = total[held, :-1] / total[held, -1:]
    return moved


def nearest_members(label: npt.NDArray[np.int32], distance: Singles, K: int) -> Ints:
    """(K,) the point closest to each centre among its own, the first of equally near ones; -1 without points."""
    member = np.full(K, -1, np.int64)
    _nearest_members(label, distance, member)
    return member


@on_every_core
@compiled()
def _radii(core: int, cores: int, points: Singles, start: Ints, mean: Singles, radius: Singles) -> None:
    for c in range(core, len(mean), cores):
        widest = 0.0
        for i in range(start[c], start[c + 1]):
            square = 0.0
            for t in range(points.shape[1]):
                square += (points[i, t] - mean[c, t]) ** 2
            widest = max(widest, square)
        radius[c] = np.sqrt(widest)


@on_every_core
@compiled()
def _cell_sums(
    core: int, cores: int, points: Singles, weight: npt.NDArray[np.float64], start: Ints, total: npt.NDArray[np.float64]
) -> None:
    p = points.shape[1]
    for c in range(core, len(total), cores):
        for i in range(start[c], start[c + 1]):
            for t in range(p):
                total[c, t] += weight[i] * points[i, t]
            total[c, p] += weight[i]


@compiled(merged=True)
def squares(point: Singles, others: Singles, out: Singles) -> None:
    """(n,) squared distances of a point (p,) to others (p, n).

    A vector register contains several others, and each sum runs from the first dimension to the last, for any width of
    the register.
    """
    p, n = others.shape
    for k in range(n):
        out[k] = 0
    for t in range(0, p - p % 4, 4):
        for k in range(n):
            a, b = others[t, k] - point[t], others[t + 1, k] - point[t + 1]
            c, d = others[t + 2, k] - point[t + 2], others[t + 3, k] - point[t + 3]
            out[k] += (a * a + b * b) + (c * c + d * d)
    for t in range(p - p % 4, p):
        for k in range(n):
            a = others[t, k] - point[t]
            out[k] += a * a


@on_every_core
@compiled()
def _attempt(
    core: int,
    cores: int,
    across: Singles,
    weight: npt.NDArray[np.float64],
    drawn: Ints,
    nearest: Singles,
    attempts: Singles,
    inertia: npt.NDArray[np.float64],
) -> None:
    """Write the squared distances (t, m) to the nearest seed, if each of the drawn points is one, and the inertia (t,).

    across (p, m): the points, dimension by dimension. nearest (m,): the squared distances to the seeds so far.
    """
    m = across.shape[1]
    for trial in range(core, len(drawn), cores):
        own = attempts[trial]
        squares(across[:, drawn[trial]].copy(), across, own)
        for i in range(m):
            own[i] = own[i] if own[i] < nearest[i] else nearest[i]
        # Four partial sums, always over the same terms.
        a, b, c, d = 0.0, 0.0, 0.0, 0.0
        for i in range(0, m - m % 4, 4):
            a, b = a + own[i] * weight[i], b + own[i + 1] * weight[i + 1]
            c, d = c + own[i + 2] * weight[i + 2], d + own[i + 3] * weight[i + 3]
        for i in range(m - m % 4, m):
            a += own[i] * weight[i]
        inertia[trial] = (a + b) + (c + d)


@on_every_core
@compiled()
def _nearest_centres(
    core: int,
    cores: int,
    points: Singles,
    start: Ints,
    mean: Singles,
    radius: Singles,
    across: Singles,
    label: npt.NDArray[np.int32],
    distance: Singles,
) -> None:
    """across (p, K): the centres, dimension by dimension."""
    p, K = across.shape
    for c in range(core, len(mean), cores):
        to_mean = np.empty(K, np.float32)
        squares(mean[c], across, to_mean)
        closest = f32(np.inf)
        for k in range(K):
            closest = to_mean[k] if to_mean[k] < closest else closest
        # The margin covers float32's rounding, so that pruning never changes a label.
        reach = (np.sqrt(closest) + f32(2) * radius[c]) * f32(1.0001) + f32(1e-3)
        candidate, candidates = np.empty(K, np.int32), 0
        for k in range(K):
            if to_mean[k] <= reach * reach:
                candidate[candidates] = k
                candidates += 1
        near, away = np.empty((p, candidates), np.float32), np.empty(candidates, np.float32)
        for t in range(p):
            for q in range(candidates):
                near[t, q] = across[t, candidate[q]]
        for i in range(start[c], start[c + 1]):
            squares(points[i], near, away)
            best, which = f32(np.inf), np.int32(0)
            for q in range(candidates):
                if away[q] < best:
                    best, which = away[q], candidate[q]
            label[i], distance[i] = which, best


@on_every_core
@compiled()
def _label_sums(
    core: int,
    cores: int,
    points: Singles,
    weight: npt.NDArray[np.float64],
    label: npt.NDArray[np.int32],
    parts: npt.NDArray[np.float64],
) -> None:
    m, p = points.shape
    for part in range(core, len(parts), cores):
        begin, end = part_of(m, part, len(parts))
        for i in range(begin, end):
            total = parts[part, label[i]]
            for t in range(p):
                total[t] += weight[i] * points[i, t]
            total[p] += weight[i]


@compiled()
def _nearest_members(label: npt.NDArray[np.int32], distance: Singles, member: npt.NDArray[Any]) -> None:
    for i in range(len(label)):
        k = label[i]
        if member[k] < 0 or distance[i] < distance[member[k]]:
            member[k] = i
