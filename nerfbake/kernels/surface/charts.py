"""Divide a triangle surface into charts that can be laid flat: arrays in, arrays out.

A chart grows from a flat place over neighbouring triangles: first those that are near and turn little from its mean
normal. It is laid flat by projection along that normal. A triangle that would cover another one of its chart there goes
to a new chart, so no chart overlaps itself. The time is that of sorting the triangles, however rough the surface is. No
loop runs in parallel.
Source: Sander et al., "Multi-chart geometry images" (2003), section 3, for the growth.
"""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Coords, Floats, Ints
from nerfbake.kernels.jit import compiled

NONE = -1
_CONES = (0.35, 0.35, 0.5, 0.5)  # least cosine to the mean normal in each round of growth
_SMALL, _ROUNDS = 24, 12  # triangles of a chart that its neighbours absorb, and how often they try
_LARGEST = 0.005  # of the surface: smaller charts pack more densely, larger ones have fewer seams
_ROUND = 0.5  # cost of the distance from the seed, in radii of the largest chart, beside 1 - cosine
_CELLS = 1024  # most cells along an axis of the grid in which overlaps are found
_CLOSE = 1e-9  # of the size of two triangles: an overlap this narrow is rounding


class Flat(NamedTuple):
    """The chart of each triangle, numbered from 0 without gaps, and its corners in the plane of that chart."""

    chart: Coords  # (t,)
    corners: Floats  # (t, 3, 2), counter-clockwise, in units of the positions


def neighbours(faces: npt.NDArray[np.uint32]) -> Coords:
    """(t, 3): the triangle across the edge from corner k to the next one; NONE on a border.

    An edge of three triangles or more, or of two that wind in opposite ways, is a border too.
    """
    t = len(faces)
    here, there = faces.astype(np.int64).reshape(-1), np.roll(faces, -1, axis=1).astype(np.int64).reshape(-1)
    edge = np.minimum(here, there) << 32 | np.maximum(here, there)
    order = np.argsort(edge, kind="stable")
    edge = edge[order]
    start = np.flatnonzero(np.r_[True, edge[1:] != edge[:-1]])
    pairs = start[np.diff(np.r_[start, len(edge)]) == 2]
    a, b = order[pairs], order[pairs + 1]
    opposite = here[a] == there[b]
    a, b = a[opposite], b[opposite]
    found = np.full(3 * t, NONE, np.int32)
    found[a], found[b] = b // 3, a // 3
    return found.reshape(t, 3)


def flatten(positions: Floats, beside: Coords, *, least: float) -> Flat:
    """Charts of t triangles, positions (t, 3, 3), beside (t, 3) as neighbours() returns it.

    least: the smallest cosine between a triangle and the normal of its chart, so that none is shortened by more than
    1 / least.
    """
    a, b, c = positions[:, 0], positions[:, 1], positions[:, 2]
    across = np.cross(b - a, c - a)
    length = np.sqrt((across * across).sum(axis=1))
    normals = across / np.where(length > 0, length, 1)[:, None]
    order = _flattest(normals, beside)
    owner, chart = np.full(len(normals), NONE, np.int32), np.full(len(normals), NONE, np.int32)
    corners = np.zeros((len(normals), 3, 2))
    laid = 0
    for narrow in _CONES:
        owner[:] = NONE
        seeds = _grow(
            positions.mean(axis=1),
            normals,
            length,
            beside,
            order,
            max(narrow, least),
            _LARGEST * float(length.sum()),
            chart,
            owner,
        )
        _absorb(normals, length, beside, seeds, least, owner)
        laid = _lay(positions, normals, length, beside, seeds, least, owner, laid, chart, corners)
    alone = np.flatnonzero(chart == NONE).astype(np.int32)
    owner[:] = NONE  # those that are laid already have numbers of another list of seeds
    owner[alone] = np.arange(len(alone))
    _lay(positions, normals, length, beside, alone, least, owner, laid, chart, corners)
    return Flat(chart, corners)


def _flattest(normals: Floats, beside: Coords) -> Ints:
    """(t,) the triangles, those that turn least from their neighbours first."""
    turn = np.ones(len(normals))
    for side in range(3):
        across = (normals * normals[beside[:, side]]).sum(axis=1)
        np.minimum(turn, np.where(beside[:, side] == NONE, 1, across), out=turn)
    return np.argsort(-turn, kind="stable")


@compiled()
def _grow(
    centres: Floats,
    normals: Floats,
    areas: Floats,
    beside: Coords,
    order: Ints,
    least: float,
    most: float,
    chart: Coords,
    owner: Coords,
) -> Coords:
    """Fill the owner of each triangle without a chart, and return the triangle from which each chart grew.

    A triangle without area joins the first chart that reaches it.
    """
    seeds = np.full(len(order), NONE, np.int32)
    reach = max(np.sqrt(most / (2 * np.pi)), 1e-300)  # the radius of a disc of the largest area
    count = 0
    for start in order:
        if owner[start] != NONE or chart[start] != NONE:
            continue
        seeds[count] = start
        x, y, z, size, members = 0.0, 0.0, 0.0, 0.0, 0
        waiting = [(0.0, np.int64(start))]
        while len(waiting) > 0:
            _, f = heapq.heappop(waiting)
            if owner[f] != NONE:
                continue
            if areas[f] > 0 and f != start:
                far = np.sqrt(x * x + y * y + z * z)
                if normals[f, 0] * x + normals[f, 1] * y + normals[f, 2] * z < least * far:
                    continue
            owner[f] = count
            size, members = size + areas[f], members + 1
            if size > most and members >= _SMALL:
                break
            x, y, z = x + areas[f] * normals[f, 0], y + areas[f] * normals[f, 1], z + areas[f] * normals[f, 2]
            far = np.sqrt(x * x + y * y + z * z)
            for side in range(3):
                g = np.int64(beside[f, side])
                if g == NONE or owner[g] != NONE or chart[g] != NONE:
                    continue
                along = normals[g, 0] * x + normals[g, 1] * y + normals[g, 2] * z
                if areas[g] == 0:
                    heapq.heappush(waiting, (0.0, g))
                elif along >= least * far:
                    # A triangle with two or three sides on the chart fills a notch: it comes first.
                    touching = 0
                    for other in range(3):
                        h = beside[g, other]
                        touching += h != NONE and owner[h] == count
                    away = 0.0
                    for axis in range(3):
                        away += (centres[g, axis] - centres[start, axis]) ** 2
                    away = np.sqrt(away) / reach
                    heapq.heappush(waiting, ((1 - along / max(far, 1e-300) + _ROUND * away) / touching, g))
        count += 1
    return seeds[:count]


@compiled()
def _absorb(normals: Floats, areas: Floats, beside: Coords, seeds: Coords, least: float, owner: Coords) -> None:
    """Give the triangles of small charts to their larger neighbours, as far as these may turn."""
    axes, sizes = np.zeros((len(seeds), 3)), np.zeros(len(seeds), np.int64)
    for f in range(len(owner)):
        k = owner[f]
        if k != NONE:
            sizes[k] += 1
            for axis in range(3):
                axes[k, axis] += areas[f] * normals[f, axis]
    for k in range(len(seeds)):
        far = np.sqrt(axes[k, 0] * axes[k, 0] + axes[k, 1] * axes[k, 1] + axes[k, 2] * axes[k, 2])
        for axis in range(3):
            axes[k, axis] /= max(far, 1e-300)
    for _ in range(_ROUNDS):
        moved = False
        for f in range(len(owner)):
            k = owner[f]
            if k == NONE or sizes[k] >= _SMALL:
                continue
            best, near = k, least
            for side in range(3):
                g = beside[f, side]
                if g == NONE or owner[g] == NONE or owner[g] == k or sizes[owner[g]] < _SMALL:
                    continue
                n = owner[g]
                along = normals[f, 0] * axes[n, 0] + normals[f, 1] * axes[n, 1] + normals[f, 2] * axes[n, 2]
                if along > near or areas[f] == 0:
                    best, near = n, along
            if best != k:
                sizes[k] -= 1
                sizes[best] += 1
                owner[f] = best
                moved = True
        if not moved:
            break


@compiled()
def _lay(
    positions: Floats,
    normals: Floats,
    areas: Floats,
    beside: Coords,
    seeds: Coords,
    least: float,
    owner: Coords,
    laid: int,
    chart: Coords,
    corners: Floats,
) -> int:
    """Project the charts that have grown; fill `chart` and `corners` of every triangle that covers no other one.

    Charts are numbered from `laid`. Returns the number after the last one.
    """
    axes = np.zeros((len(seeds), 3))
    for f in range(len(owner)):
        if owner[f] != NONE:
            for axis in range(3):
                axes[owner[f], axis] += areas[f] * normals[f, axis]
    queue, seen = np.empty(len(owner), np.int64), np.zeros(len(owner), np.bool_)
    for k in range(len(seeds)):
        if owner[seeds[k]] != k:
            continue  # absorbed
        n = axes[k]
        far = np.sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2])
        if far == 0:
            n[0], n[1], n[2], far = 0.0, 0.0, 1.0, 1.0
        for axis in range(3):
            n[axis] /= far
        queue[0], seen[seeds[k]] = seeds[k], True
        first, last = 0, 1
        while first < last:
            for side in range(3):
                g = beside[queue[first], side]
                if g != NONE and owner[g] == k and not seen[g]:
                    queue[last], seen[g] = g, True
                    last += 1
            first += 1
        members = queue[:last]
        _project(positions, members, n, corners)
        _keep_apart(members, beside, corners, normals, areas, n, least, laid, chart)
        laid += 1
    return laid


@compiled()
def _project(positions: Floats, members: Ints, n: Floats, corners: Floats) -> None:
    """Fill the corners of these triangles in the plane across n (3,), a unit vector."""
    # One of the axes, at 54 degrees or more from n.
    e0, e1, e2 = 0.0, 0.0, 0.0
    if abs(n[0]) <= abs(n[1]) and abs(n[0]) <= abs(n[2]):
        e0 = 1.0
    elif abs(n[1]) <= abs(n[2]):
        e1 = 1.0
    else:
        e2 = 1.0
    u0, u1, u2 = e1 * n[2] - e2 * n[1], e2 * n[0] - e0 * n[2], e0 * n[1] - e1 * n[0]
    far = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    u0, u1, u2 = u0 / far, u1 / far, u2 / far
    v0, v1, v2 = n[1] * u2 - n[2] * u1, n[2] * u0 - n[0] * u2, n[0] * u1 - n[1] * u0
    for f in members:
        for corner in range(3):
            p = positions[f, corner]
            corners[f, corner, 0] = p[0] * u0 + p[1] * u1 + p[2] * u2
            corners[f, corner, 1] = p[0] * v0 + p[1] * v1 + p[2] * v2


@compiled()
def _keep_apart(
    members: Ints,
    beside: Coords,
    corners: Floats,
    normals: Floats,
    areas: Floats,
    n: Floats,
    least: float,
    number: int,
    chart: Coords,
) -> None:
    """Set the chart of the members that turn little enough, touch those before them, and cover none.

    A grid of cells finds the members that may be covered.
    """
    left, top, right, bottom = np.inf, np.inf, -np.inf, -np.inf
    for f in members:
        for corner in range(3):
            x, y = corners[f, corner, 0], corners[f, corner, 1]
            left, right, top, bottom = min(left, x), max(right, x), min(top, y), max(bottom, y)
    cell = max(
        np.sqrt((right - left) * (bottom - top) / len(members)), max(right - left, bottom - top) / _CELLS, 1e-300
    )
    across, down = int((right - left) / cell) + 1, int((bottom - top) / cell) + 1
    boxes = np.empty((len(members), 4), np.int64)
    entries = 0
    for i in range(len(members)):
        a, b, c = corners[members[i], 0], corners[members[i], 1], corners[members[i], 2]
        boxes[i, 0] = int((min(a[0], b[0], c[0]) - left) / cell)
        boxes[i, 1] = int((min(a[1], b[1], c[1]) - top) / cell)
        boxes[i, 2] = int((max(a[0], b[0], c[0]) - left) / cell)
        boxes[i, 3] = int((max(a[1], b[1], c[1]) - top) / cell)
        entries += (boxes[i, 2] - boxes[i, 0] + 1) * (boxes[i, 3] - boxes[i, 1] + 1)
    head = np.full((down, across), NONE, np.int32)
    follow, held = np.empty(entries, np.int32), np.empty(entries, np.int64)
    count = 0
    for i in range(len(members)):
        f = members[i]
        fine = i == 0
        for side in range(3):  # a chart has one piece
            fine |= beside[f, side] != NONE and chart[beside[f, side]] == number
        if areas[f] > 0 and len(members) > 1:
            fine &= normals[f, 0] * n[0] + normals[f, 1] * n[1] + normals[f, 2] * n[2] >= least
            for y in range(boxes[i, 1], boxes[i, 3] + 1):
                for x in range(boxes[i, 0], boxes[i, 2] + 1):
                    entry = head[y, x]
                    while fine and entry != NONE:
                        fine = not overlap(corners[f], corners[held[entry]])
                        entry = follow[entry]
        if fine:
            chart[f] = number
            for y in range(boxes[i, 1], boxes[i, 3] + 1):
                for x in range(boxes[i, 0], boxes[i, 2] + 1):
                    follow[count], held[count] = head[y, x], f
                    head[y, x] = count
                    count += 1


@compiled()
def overlap(a: Floats, b: Floats) -> bool:
    """Whether two triangles (3, 2) in the plane have an area in common, by their separating lines.

    Triangles that share an edge or a corner do not. A triangle without area has nothing in common with others.
    """
    for t in range(2):
        own, other = (a, b) if t == 0 else (b, a)
        for corner in range(3):
            p, q = own[corner], own[(corner + 1) % 3]
            dx, dy = p[1] - q[1], q[0] - p[0]
            least, most = np.inf, -np.inf
            near, far = np.inf, -np.inf
            for k in range(3):
                s = (own[k, 0] - p[0]) * dx + (own[k, 1] - p[1]) * dy
                least, most = min(least, s), max(most, s)
                s = (other[k, 0] - p[0]) * dx + (other[k, 1] - p[1]) * dy
                near, far = min(near, s), max(far, s)
            close = _CLOSE * (max(most, far) - min(least, near))
            if min(most, far) - max(least, near) <= close:
                return False
    return True
