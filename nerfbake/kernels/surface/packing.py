"""Pack charts into a square texture: arrays in, arrays out.

Charts lie on their longer side and are placed one after the other, the longest first, in the first row of texels where
there is space, as far to the left as possible. A chart takes, in each row, all texels from the first to the last one
that a bilinear lookup in it reads, and _GUTTER more, which no other chart may take. The largest scale at which all
charts fit is found by bisection.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.maths.elementary import sine_cosine

_TURNS = 16  # angles of a quarter turn at which the box around a chart is measured
_GUTTER = 1  # texels between the texels that two charts read
_PAST = 1 / 64  # texels from the centre of a chart's first texel to its first point, for rounding
_CLASSES = 64  # of widths and of heights, each a quarter larger than the one before
_FIRST = 0.85  # of the texture that a first guess covers
_TRIES = 7  # scales that are tried after the first one that fits
_LEAST = 1e-3  # of the first guess: a smaller scale does not help


def pack(order: Ints, starts: Ints, corners: Floats, areas: Floats, edge: int) -> Floats | None:
    """Positions (t, 3, 2) in a texture of edge x edge texels; None if the charts do not fit at any scale.

    order: the triangles chart by chart, starts (k + 1,) where each chart begins in it. corners (t, 3, 2) in the plane
    of the chart; areas (t,) of the triangles in space: charts are scaled until they have the area of their triangles.
    """
    upright = corners.copy()
    turns = np.stack(sine_cosine(np.arange(_TURNS) * (np.pi / 2 / _TURNS)), axis=1)
    boxes = np.zeros((len(starts) - 1, 2))
    _turn(order, starts, upright, areas, turns, boxes)
    by_size = np.argsort(-boxes.max(axis=1), kind="stable")
    places = np.zeros((len(boxes), 2), np.int64)
    total = float(areas.sum())
    first = float(np.sqrt(_FIRST * edge * edge / total)) if total > 0 else 1.0
    low, high, scale = 0.0, 0.0, first
    tries = 0
    best: Ints | None = None
    while tries < _TRIES and scale > _LEAST * first:
        if _place(order, starts, upright, by_size, boxes, scale, edge, places):
            low, best = scale, places.copy()
            tries += 1
        else:
            high = scale
            tries += best is not None
        scale = (low + high) / 2 if low and high else scale * (1.25 if low else 0.85)
    if best is None:
        return None
    owner = np.repeat(np.arange(len(boxes)), np.diff(starts))
    out = np.empty_like(upright)
    out[order] = upright[order] * low + best[owner][:, None] + (0.5 + _PAST)
    return out


@compiled()
def _turn(order: Ints, starts: Ints, corners: Floats, areas: Floats, turns: Floats, boxes: Floats) -> None:
    """Scale and turn each chart in place, so that its box is small and upright and starts at 0, 0."""
    for k in range(len(starts) - 1):
        members = order[starts[k] : starts[k + 1]]
        wanted, flat = 0.0, 0.0
        for f in members:
            a, b, c = corners[f, 0], corners[f, 1], corners[f, 2]
            wanted += areas[f]
            flat += abs((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])) / 2
        grow = np.sqrt(wanted / flat) if flat > 0 else 1.0
        best, least, box = 0, np.inf, np.zeros(4)
        for turn in range(len(turns)):
            s, c0 = turns[turn]
            low_x, low_y, high_x, high_y = np.inf, np.inf, -np.inf, -np.inf
            for f in members:
                for corner in range(3):
                    x, y = corners[f, corner, 0], corners[f, corner, 1]
                    x, y = c0 * x - s * y, s * x + c0 * y
                    low_x, high_x, low_y, high_y = min(low_x, x), max(high_x, x), min(low_y, y), max(high_y, y)
            size = (high_x - low_x) * (high_y - low_y)
            if size < least:
                best, least = turn, size
                box[0], box[1], box[2], box[3] = low_x, low_y, high_x, high_y
        s, c0 = turns[best]
        lying = box[2] - box[0] < box[3] - box[1]
        boxes[k, 0], boxes[k, 1] = grow * (box[2] - box[0]), grow * (box[3] - box[1])
        if lying:
            boxes[k, 0], boxes[k, 1] = boxes[k, 1], boxes[k, 0]
        for f in members:
            for corner in range(3):
                x, y = corners[f, corner, 0], corners[f, corner, 1]
                x, y = c0 * x - s * y, s * x + c0 * y
                if lying:  # a quarter turn
                    corners[f, corner, 0], corners[f, corner, 1] = grow * (box[3] - y), grow * (x - box[0])
                else:
                    corners[f, corner, 0], corners[f, corner, 1] = grow * (x - box[0]), grow * (y - box[1])


@compiled()
def _place(
    order: Ints, starts: Ints, corners: Floats, by_size: Ints, boxes: Floats, scale: float, edge: int, places: Ints
) -> bool:
    """Fill the first texel (k, 2) of each chart at a scale in texels; False if they do not fit.

    A chart comes to the lowest row where there is space, as far to the left as possible. Charts of about the same size
    start their search where the last one found space.
    """
    wide = edge + _GUTTER  # the gutters of the last charts may lie outside of the texture
    after = np.full((wide, wide + 1), wide, np.int32)  # the next taken texel of the row, from each texel on
    free = np.empty((wide, wide), np.int32)  # the next free texel of the row, from each taken texel on
    left, right = np.empty(wide, np.int64), np.empty(wide, np.int64)
    from_row = np.zeros((_CLASSES, _CLASSES), np.int64)
    for k in by_size:
        tall = _outline(order[starts[k] : starts[k + 1]], corners, scale, left, right)
        if tall > wide:
            return False
        width = np.int64(0)
        for r in range(tall):
            width = max(width, right[r] + 1)
        row, column = _class(scale * boxes[k, 0]), _class(scale * boxes[k, 1])
        found = False
        for y in range(from_row[row, column], wide - tall + 1):
            x = np.int64(0)
            tested = 0  # rows in a row that have space at x
            r = 0
            while x + width <= wide and tested < tall:
                taken = after[y + r, x + left[r]]
                if taken <= x + right[r]:
                    x = free[y + r, taken] - left[r]
                    tested = 0
                else:
                    tested += 1
                    r = r + 1 if r + 1 < tall else 0
            if tested == tall:
                places[k, 0], places[k, 1] = x, y
                for r in range(tall):
                    _take(after[y + r], free[y + r], x + left[r], x + right[r])
                from_row[row, column] = y
                found = True
                break
        if not found:
            return False
    return True


@compiled()
def _class(size: float) -> int:
    """Sizes of one class differ by less than a quarter."""
    found, most = 0, 1.0
    while size > most and found < _CLASSES - 1:
        most *= 1.25
        found += 1
    return found


@compiled()
def _take(after: npt.NDArray[np.int32], free: npt.NDArray[np.int32], first: int, last: int) -> None:
    """Take the texels first to last of a row, which are free."""
    end = last + 1
    if after[end] == end and end < len(free):
        end = free[end]  # they touch the run to the right
    for x in range(first, last + 1):
        after[x], free[x] = x, end
    x = first - 1
    while x >= 0 and after[x] > first:
        after[x] = first
        x -= 1
    while x >= 0 and after[x] == x and free[x] == first:
        free[x] = end
        x -= 1


@compiled()
def _outline(members: Ints, corners: Floats, scale: float, left: Ints, right: Ints) -> int:
    """Fill the first and the last texel of a chart in each of its rows; returns their number.

    These are the texels that a bilinear lookup in the chart reads, and _GUTTER more to the right and above.
    """
    limit = len(left)
    left[:], right[:] = limit, -1
    tall = 0
    for f in members:
        for corner in range(3):
            a, b = corners[f, corner], corners[f, (corner + 1) % 3]
            if a[1] > b[1]:
                a, b = b, a
            # In texel centres: a lookup at y reads the rows floor(y) and floor(y) + 1.
            ax, ay, bx, by = scale * a[0] + _PAST, scale * a[1] + _PAST, scale * b[0] + _PAST, scale * b[1] + _PAST
            slope = (bx - ax) / (by - ay) if by > ay else 0.0
            first, last = int(np.floor(ay)), int(np.floor(by)) + 1
            if last + 1 + _GUTTER > limit or max(ax, bx) > limit - 3:
                return limit + 1
            for j in range(first, last + 1):
                low, high = max(ay, j - 1.0), min(by, j + 1.0)
                x0, x1 = (ax, bx) if by == ay else (ax + slope * (low - ay), ax + slope * (high - ay))
                near, far = int(np.floor(min(x0, x1))), int(np.floor(max(x0, x1))) + 1 + _GUTTER
                for i in range(j, j + 1 + _GUTTER):
                    left[i], right[i] = min(left[i], near), max(right[i], far)
            tall = max(tall, last + 1 + _GUTTER)
    return tall
