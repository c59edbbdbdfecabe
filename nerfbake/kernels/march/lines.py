"""A ray as a line through a lattice: where it enters a box, which cell contains it, and which cell is next.

Places and directions are in cells. All functions are merged into the kernels that call them.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.jit import compiled

Triple = tuple[float, float, float]
Place = tuple[int, int, int]


class Line(NamedTuple):
    """The places origin + t * direction. inverse: one over the direction, infinite where it is 0."""

    origin: Triple
    direction: Triple
    inverse: Triple


@compiled(merged=True)
def line_of(origin: Triple, direction: Triple) -> Any:
    """Return the line through a place along a direction."""
    d0, d1, d2 = direction
    i0 = 1 / d0 if d0 != 0 else np.inf
    i1 = 1 / d1 if d1 != 0 else np.inf
    i2 = 1 / d2 if d2 != 0 else np.inf
    return Line(origin, direction, (i0, i1, i2))


@compiled(merged=True)
def line_in_box(box: Floats, origin: Floats, directions: Floats, ray: int, stop: float) -> Any:
    """Return the line of a ray from where it enters a box, start and end of its part in the box, and a world unit.

    start and end: distances from the camera, in cells, and the unit in cells. stop: where the ray ends, in world units.
    The line begins at the box, so distances along it stay small and exact, however far away the camera is.
    """
    d0, d1, d2 = directions[ray, 0], directions[ray, 1], directions[ray, 2]
    scale = np.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
    d0, d1, d2 = d0 / scale, d1 / scale, d2 / scale
    low, high = (box[0, 0], box[0, 1], box[0, 2]), (box[1, 0], box[1, 1], box[1, 2])
    start, end = part_in_box(low, high, (origin[0], origin[1], origin[2]), (d0, d1, d2), stop * scale)
    line = line_of((origin[0] + start * d0, origin[1] + start * d1, origin[2] + start * d2), (d0, d1, d2))
    return line, start, max(start, end), scale


@compiled(merged=True)
def part_in_box(low: Triple, high: Triple, origin: Triple, direction: Triple, end: float) -> Any:
    """Return start and end of the part of a ray, from 0 to end, in the box from low to high; end < start: none."""
    start = 0.0
    start, end = _clip(low[0] - origin[0], high[0] - origin[0], direction[0], start, end)
    start, end = _clip(low[1] - origin[1], high[1] - origin[1], direction[1], start, end)
    return _clip(low[2] - origin[2], high[2] - origin[2], direction[2], start, end)


@compiled(merged=True)
def _clip(low: float, high: float, d: float, start: float, end: float) -> Any:
    """Clip a ray from start to end to low .. high along one axis, all relative to its origin."""
    if d == 0:
        return start, end if low <= 0 < high else -1.0
    return max(start, min(low / d, high / d)), min(end, max(low / d, high / d))


@compiled(merged=True)
def cells_at_corners(box: Floats) -> Any:
    """Return the first and the last cell of a box (2, 3)."""
    return (box[0, 0], box[0, 1], box[0, 2]), (box[1, 0] - 1, box[1, 1] - 1, box[1, 2] - 1)


@compiled(merged=True)
def cell_at(line: Line, t: float, first: Triple, last: Triple) -> Any:
    """Return the cell at t, clamped to first .. last."""
    x = _along(line, t, 0, first[0], last[0])
    y = _along(line, t, 1, first[1], last[1])
    z = _along(line, t, 2, first[2], last[2])
    return x, y, z


@compiled(merged=True)
def _along(line: Line, t: float, axis: int, low: float, high: float) -> int:
    """Return the coordinate of the cell at t along one axis, clamped to low .. high."""
    return containing_cell(line.origin[axis] + t * line.direction[axis], low, high)


@compiled(merged=True)
def containing_cell(place: float, low: float, high: float) -> int:
    """Return the cell that contains a place on one axis, clamped to low .. high."""
    return int(min(max(np.floor(place), low), high))


@compiled(merged=True)
def exits(low: Triple, width: float, line: Line) -> Any:
    """Return where a ray leaves the cell whose lowest corner is `low`, along each axis."""
    o, d, i = line.origin, line.direction, line.inverse
    exit0 = ((low[0] + width if d[0] > 0 else low[0]) - o[0]) * i[0] if d[0] != 0 else np.inf
    exit1 = ((low[1] + width if d[1] > 0 else low[1]) - o[1]) * i[1] if d[1] != 0 else np.inf
    exit2 = ((low[2] + width if d[2] > 0 else low[2]) - o[2]) * i[2] if d[2] != 0 else np.inf
    return exit0, exit1, exit2


@compiled(merged=True)
def next_cell(low: Triple, width: float, crossings: Triple, line: Line, t: float) -> Any:
    """Return the cell that a ray enters when it leaves a cell at t, and the axis of the face between them.

    crossings: exits() of the cell. Steps by cell number, not by a small distance: rounding can neither stop a ray nor
    skip a cell.
    """
    l0, l1, l2 = low
    last = width - 1
    if crossings[0] <= crossings[1] and crossings[0] <= crossings[2]:
        return (_beyond(line, 0, l0, width), _along(line, t, 1, l1, l1 + last), _along(line, t, 2, l2, l2 + last)), 0
    if crossings[1] <= crossings[2]:
        return (_along(line, t, 0, l0, l0 + last), _beyond(line, 1, l1, width), _along(line, t, 2, l2, l2 + last)), 1
    return (_along(line, t, 0, l0, l0 + last), _along(line, t, 1, l1, l1 + last), _beyond(line, 2, l2, width)), 2


@compiled(merged=True)
def _beyond(line: Line, axis: int, low: float, width: float) -> int:
    """Return the coordinate of the next cell along one axis."""
    return int(low + width if line.direction[axis] > 0 else low - 1)


@compiled(merged=True)
def is_within(cell: Place, axis: int, first: Triple, last: Triple) -> bool:
    """Return whether a cell lies in first .. last along one axis."""
    if axis == 0:
        return first[0] <= cell[0] <= last[0]
    if axis == 1:
        return first[1] <= cell[1] <= last[1]
    return first[2] <= cell[2] <= last[2]
