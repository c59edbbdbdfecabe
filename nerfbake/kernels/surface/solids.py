"""Rays against boxes and rods, lit by a lamp: what each ray meets first, exactly.

A uniform grid lists the solids in each of its cells, so thousands of them cost little more than a few.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats, Ints, Points, Singles
from nerfbake.kernels.jit import borrowed, compiled, next_task
from nerfbake.kernels.march.lines import Triple, cell_at, exits, line_of, next_cell, part_in_box
from nerfbake.kernels.parallel import taken_in_turn

CELLS = 64  # of the grid along each axis
_BLOCK = 1024  # rays that a core traces before it takes the next ones
_OFF = 1e-6  # distance from a surface at which a ray to the lamp starts, in world units
_AMBIENT, _LAMP, _SKY = 0.35, 0.65, 0.25  # light from all sides, of the lamp, and of a mirrored sky straight above
_SHARPER = 5  # the mirrored lamp has the brightness of a cosine to the power of 2^5


class Solids(NamedTuple):
    """Solids in world units. first, second (n, 3): lowest and highest corner of a box, or the ends of a rod's axis.

    radius (n,): of a rod with flat ends, or 0 for a box. colour (n, 3): sRGB. gloss (n,): the share of mirrored light.
    """

    first: Points
    second: Points
    radius: Floats
    colour: Floats
    gloss: Floats


class SolidGrid(NamedTuple):
    """The solids of each cell: those of cell c are held[begin[c] : begin[c + 1]]. low, size (3,): its place."""

    low: Floats
    size: Floats
    begin: Ints
    held: Ints


def grid_of(solids: Solids) -> SolidGrid:
    """Return the grid around the solids."""
    reach = solids.radius[:, None]
    lows, highs = np.minimum(solids.first, solids.second) - reach, np.maximum(solids.first, solids.second) + reach
    low, high = lows.min(axis=0), highs.max(axis=0)
    margin = 1e-6 * (high - low).max()
    low, size = low - margin, (high - low + 2 * margin) / CELLS
    extent = np.floor((np.stack([lows, highs], axis=1) - low) / size).astype(np.int64)
    pairs = np.empty((0, 2), np.int64)
    for _ in range(2):
        pairs = np.empty((_list_solids(solids, low, size, extent, pairs), 2), np.int64)
    _list_solids(solids, low, size, extent, pairs)
    pairs = pairs[np.argsort(pairs[:, 0], kind="stable")]
    return SolidGrid(low, size, np.searchsorted(pairs[:, 0], np.arange(CELLS**3 + 1)), pairs[:, 1].copy())


@compiled()
def _list_solids(solids: Solids, low: Floats, size: Floats, extent: Ints, pairs: Ints) -> int:
    """Write a pair (cell, solid) for each cell that a solid may reach into, and return how many there are."""
    width = np.sqrt(size[0] * size[0] + size[1] * size[1] + size[2] * size[2]) / 2
    count = 0
    for solid in range(len(solids.radius)):
        for x in range(extent[solid, 0, 0], extent[solid, 1, 0] + 1):
            for y in range(extent[solid, 0, 1], extent[solid, 1, 1] + 1):
                for z in range(extent[solid, 0, 2], extent[solid, 1, 2] + 1):
                    middle = low[0] + (x + 0.5) * size[0], low[1] + (y + 0.5) * size[1], low[2] + (z + 0.5) * size[2]
                    if solids.radius[solid] > 0 and _from_axis(solids, solid, middle) > solids.radius[solid] + width:
                        continue
                    if count < len(pairs):
                        pairs[count, 0], pairs[count, 1] = (x * CELLS + y) * CELLS + z, solid
                    count += 1
    return count


@compiled(merged=True)
def _from_axis(solids: Solids, solid: int, place: Triple) -> Any:
    """Return the distance of a place from the axis of a rod."""
    square, dot, away = 0.0, 0.0, 0.0
    for k in range(3):
        step, off = solids.second[solid, k] - solids.first[solid, k], place[k] - solids.first[solid, k]
        square, dot = square + step * step, dot + step * off
    share = min(max(dot / square, 0.0), 1.0)
    for k in range(3):
        step, off = solids.second[solid, k] - solids.first[solid, k], place[k] - solids.first[solid, k]
        away += (off - share * step) * (off - share * step)
    return np.sqrt(away)


@taken_in_turn
@compiled()
def trace_solids(
    turn: Ints, solids: Solids, grid: SolidGrid, lamp: Floats, eye: Floats, directions: Floats, out: Singles
) -> None:
    """Write colour, alpha and depth (m, 5) of each ray: 0 if it meets nothing.

    lamp (3,): the unit direction to the lamp, which casts shadows. eye (3,): the camera, outside all solids.
    directions (m, 3): unit vectors. The mirrored light is not shadowed by what is in its way but for the lamp's.
    """
    solids, grid, lamp, eye, directions, out = borrowed((solids, grid, lamp, eye, directions, out))
    normal = np.empty(3)
    while True:
        begin = next_task(turn) * _BLOCK
        if begin >= len(directions):
            break
        for ray in range(begin, min(begin + _BLOCK, len(directions))):
            d = directions[ray, 0], directions[ray, 1], directions[ray, 2]
            out[ray, :] = 0
            solid, t = _first_solid(solids, grid, (eye[0], eye[1], eye[2]), d, normal)
            if solid < 0:
                continue
            n0, n1, n2 = normal[0], normal[1], normal[2]
            facing = n0 * lamp[0] + n1 * lamp[1] + n2 * lamp[2]
            along = n0 * d[0] + n1 * d[1] + n2 * d[2]
            at = eye[0] + t * d[0] + _OFF * n0, eye[1] + t * d[1] + _OFF * n1, eye[2] + t * d[2] + _OFF * n2
            m = d[0] - 2 * along * n0, d[1] - 2 * along * n1, d[2] - 2 * along * n2
            shine = _SKY * max(m[2], 0.0)
            lit = 0.0
            if facing > 0 and _first_solid(solids, grid, at, (lamp[0], lamp[1], lamp[2]), normal)[0] < 0:
                lit = _LAMP * facing
                lobe = max(m[0] * lamp[0] + m[1] * lamp[1] + m[2] * lamp[2], 0.0)
                for _ in range(_SHARPER):
                    lobe *= lobe
                shine += lobe
            for k in range(3):
                colour = solids.colour[solid, k] * (_AMBIENT + lit) + solids.gloss[solid] * shine
                out[ray, k] = min(colour, 1.0)
            out[ray, 3], out[ray, 4] = 1, t


@compiled()
def _first_solid(solids: Solids, grid: SolidGrid, origin: Triple, d: Triple, normal: Floats) -> Any:
    """Return the first solid on a ray, -1 if there is none, and its distance; fill the normal there."""
    s0, s1, s2 = grid.size[0], grid.size[1], grid.size[2]
    place = (origin[0] - grid.low[0]) / s0, (origin[1] - grid.low[1]) / s1, (origin[2] - grid.low[2]) / s2
    line = line_of(place, (d[0] / s0, d[1] / s1, d[2] / s2))
    t, end = part_in_box((0.0, 0.0, 0.0), (CELLS, CELLS, CELLS), line.origin, line.direction, np.inf)
    found, nearest, last = -1, np.inf, CELLS - 1
    if t >= end:
        return found, nearest
    x, y, z = cell_at(line, t, (0, 0, 0), (last, last, last))
    while 0 <= x <= last and 0 <= y <= last and 0 <= z <= last:
        cell = (x * CELLS + y) * CELLS + z
        for k in range(grid.begin[cell], grid.begin[cell + 1]):
            solid = grid.held[k]
            if solids.radius[solid] > 0:
                at = _meet_rod(solids, solid, origin, d, nearest, normal)
            else:
                at = _meet_box(solids, solid, origin, d, nearest, normal)
            if at < nearest:
                found, nearest = solid, at
        crossings = exits((x, y, z), 1, line)
        t = max(min(crossings), t)
        if nearest <= t:
            break
        (x, y, z), _ = next_cell((x, y, z), 1, crossings, line, t)
    return found, nearest


@compiled(merged=True)
def _meet_box(solids: Solids, solid: int, origin: Triple, d: Triple, nearest: float, normal: Floats) -> float:
    """Return where a ray enters a box, and fill the normal if that is nearer; infinity if it does not."""
    enter, leave, axis = -np.inf, np.inf, 0
    for k in range(3):
        low, high = solids.first[solid, k] - origin[k], solids.second[solid, k] - origin[k]
        if d[k] == 0:
            if low > 0 or high < 0:
                return np.inf
            continue
        near, far = min(low / d[k], high / d[k]), max(low / d[k], high / d[k])
        if near > enter:
            enter, axis = near, k
        leave = min(leave, far)
    if enter <= 0 or enter >= leave:
        return np.inf
    if enter < nearest:
        normal[0], normal[1], normal[2] = 0, 0, 0
        normal[axis] = -1 if d[axis] > 0 else 1
    return enter


@compiled(merged=True)
def _meet_rod(solids: Solids, solid: int, origin: Triple, d: Triple, nearest: float, normal: Floats) -> float:
    """Return where a ray meets a rod, and fill the normal if that is nearer; infinity if it does not."""
    first, second, radius = solids.first, solids.second, solids.radius[solid]
    u0, u1, u2 = (
        second[solid, 0] - first[solid, 0],
        second[solid, 1] - first[solid, 1],
        second[solid, 2] - first[solid, 2],
    )
    length = np.sqrt(u0 * u0 + u1 * u1 + u2 * u2)
    u0, u1, u2 = u0 / length, u1 / length, u2 / length
    o0, o1, o2 = origin[0] - first[solid, 0], origin[1] - first[solid, 1], origin[2] - first[solid, 2]
    start, slope = o0 * u0 + o1 * u1 + o2 * u2, d[0] * u0 + d[1] * u1 + d[2] * u2
    # Across the axis, the ray is o + t v.
    o0, o1, o2 = o0 - start * u0, o1 - start * u1, o2 - start * u2
    v0, v1, v2 = d[0] - slope * u0, d[1] - slope * u1, d[2] - slope * u2
    a, b = v0 * v0 + v1 * v1 + v2 * v2, o0 * v0 + o1 * v1 + o2 * v2
    c = o0 * o0 + o1 * o1 + o2 * o2 - radius * radius
    root = b * b - a * c
    if a > 0 and root > 0:
        t = (-b - np.sqrt(root)) / a
        if t > 0 and 0 <= start + t * slope <= length:
            if t < nearest:
                normal[0], normal[1], normal[2] = (o0 + t * v0) / radius, (o1 + t * v1) / radius, (o2 + t * v2) / radius
            return float(t)
    if slope == 0:
        return np.inf
    t = ((0.0 if slope > 0 else length) - start) / slope
    if t <= 0 or a * t * t + 2 * b * t + c > 0:
        return np.inf
    if t < nearest:
        side = -1.0 if slope > 0 else 1.0
        normal[0], normal[1], normal[2] = side * u0, side * u1, side * u2
    return float(t)
