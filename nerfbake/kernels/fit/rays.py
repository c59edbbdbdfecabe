"""One view's rays through the bricks, and back: what each cell should do to look more like the picture."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.fit.bricks import (
    BLAME,
    COLOUR_SUM,
    CURVATURE,
    DENSITY_SUM,
    MOST,
    SIGMA,
    UNMET,
    WEIGHT,
    Batch,
    Bricks,
    Whole,
)
from nerfbake.kernels.fit.colours import enter, new_room
from nerfbake.kernels.fit.hull import part_between
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.march.traversal import shuffled, within
from nerfbake.kernels.maths.elementary import exp

OPAQUE = 0.01  # of the light: a ray ends where less gets through
_PER = 64  # steps of the table of exponentials to one unit
_FALL = exp(-np.arange(40 * _PER) / _PER)


class Hits(NamedTuple):
    """The cells that a pixel's rays have met: their rows, the ray's length in each, and what gets through behind."""

    row: npt.NDArray[np.int32]
    length: Singles
    through: Singles


@compiled(parallel=True)
def march_view(
    bricks: Bricks,
    batch: Batch,
    eye: Floats,
    directions: Singles,
    targets: Singles,
    background: Singles,
    alpha_weight: float,
    point_weight: float,
    errors: Floats,
) -> None:
    """Fills the batch with what the pixels ask of the cells.

    eye (3,) and directions (pixels rays, 3), unit, in the world; rays of a pixel stand together. targets (pixels, 4):
    colour over the background, and alpha. errors (tasks,): the sum of squares of what colours are off.
    """
    tasks = batch.base.shape[0]
    for turn in prange(tasks):
        task = shuffled(turn, tasks)
        errors[task] = _march_part(
            bricks, batch, task, eye, directions, targets, background, alpha_weight, point_weight
        )


@compiled()
def _march_part(
    bricks: Bricks,
    batch: Batch,
    task: Whole,
    eye: Floats,
    directions: Singles,
    targets: Singles,
    background: Singles,
    alpha_weight: float,
    point_weight: float,
) -> float:
    """One task's pixels, and its rows of the batch."""
    batch.used[task] = 0
    batch.base[task, :] = UNMET
    tasks, pixels = batch.base.shape[0], len(targets)
    rays = len(directions) // max(pixels, 1)
    most = 4 * 8 * bricks.top.shape[0] * rays
    hits = Hits(np.empty(most, np.int32), np.empty(most, np.float32), np.empty(most, np.float32))
    room = new_room((len(bricks.values) // bricks.first[-1] - 1) // 3)
    seen, ends, error = np.zeros(4), np.zeros(rays + 1, np.int64), 0.0
    place = (eye - bricks.low) / bricks.size
    for pixel in range(pixels * task // tasks, pixels * (task + 1) // tasks):
        seen[:] = 0
        for ray in range(rays):
            ends[ray + 1] = _forth(
                bricks, batch, task, eye, place, directions, pixel * rays + ray, room, hits, ends[ray], seen, background
            )
        for k in range(4):
            seen[k] = targets[pixel, k] - seen[k] / rays
        error += seen[0] * seen[0] + seen[1] * seen[1] + seen[2] * seen[2]
        for ray in range(rays):
            _back(
                batch,
                task,
                hits,
                ends[ray],
                ends[ray + 1],
                seen,
                targets,
                pixel,
                background,
                alpha_weight,
                point_weight,
            )
    return error


@compiled()
def _forth(
    bricks: Bricks,
    batch: Batch,
    task: Whole,
    eye: Floats,
    place: Floats,
    directions: Singles,
    ray: int,
    room: Singles,
    hits: Hits,
    count: Whole,
    seen: Floats,
    background: Singles,
) -> Whole:
    """Adds a ray's colour and alpha to `seen` and its hits to the others; gives their number."""
    top, slots, rows = bricks.top, bricks.slots, batch.rows[task]
    o0, o1, o2 = place[0], place[1], place[2]
    d0, d1, d2 = (
        directions[ray, 0] / bricks.size[0],
        directions[ray, 1] / bricks.size[1],
        directions[ray, 2] / bricks.size[2],
    )
    i0 = 1 / d0 if d0 != 0 else np.inf
    i1 = 1 / d1 if d1 != 0 else np.inf
    i2 = 1 / d2 if d2 != 0 else np.inf
    edge = 8 * top.shape[0]
    t, end = part_between(o0, i0, edge, 0.0, np.inf)
    t, end = part_between(o1, i1, edge, t, end)
    t, end = part_between(o2, i2, edge, t, end)
    x, y, z = within(o0 + t * d0, 0, edge - 1), within(o1 + t * d1, 0, edge - 1), within(o2 + t * d2, 0, edge - 1)
    through, red, green, blue = 1.0, 0.0, 0.0, 0.0
    up0, up1, up2 = d0 > 0, d1 > 0, d2 > 0
    while t < end:
        b0, b1, b2 = x >> 3, y >> 3, z >> 3
        brick = np.int64(top[b0, b1, b2])
        base = np.int64(-1)
        if brick >= 0:
            base = np.int64(batch.base[task, brick])
            if base == UNMET:
                base = enter(bricks, batch, task, brick, (b0, b1, b2), eye, room)
        if base < 0:
            # Empty bricks as far as they are known to reach, in all directions.
            away: Whole = max(-brick, 1)
            l0, l1, l2, width = (b0 - away + 1) << 3, (b1 - away + 1) << 3, (b2 - away + 1) << 3, (2 * away - 1) << 3
            exit0 = ((l0 + width if up0 else l0) - o0) * i0 if d0 != 0 else np.inf
            exit1 = ((l1 + width if up1 else l1) - o1) * i1 if d1 != 0 else np.inf
            exit2 = ((l2 + width if up2 else l2) - o2) * i2 if d2 != 0 else np.inf
            if exit0 <= exit1 and exit0 <= exit2:
                t = max(t, exit0)
                x = l0 + width if up0 else l0 - 1
                y, z = within(o1 + t * d1, l1, l1 + width - 1), within(o2 + t * d2, l2, l2 + width - 1)
            elif exit1 <= exit2:
                t = max(t, exit1)
                y = l1 + width if up1 else l1 - 1
                x, z = within(o0 + t * d0, l0, l0 + width - 1), within(o2 + t * d2, l2, l2 + width - 1)
            else:
                t = max(t, exit2)
                z = l2 + width if up2 else l2 - 1
                x, y = within(o0 + t * d0, l0, l0 + width - 1), within(o1 + t * d1, l1, l1 + width - 1)
        else:
            while True:
                slot = np.int64(slots[brick, (x & 7) << 6 | (y & 7) << 3 | z & 7])
                wide: Whole = slot & 1
                l0, l1, l2, width = x & ~wide, y & ~wide, z & ~wide, 1 + wide
                exit0 = ((l0 + width if up0 else l0) - o0) * i0 if d0 != 0 else np.inf
                exit1 = ((l1 + width if up1 else l1) - o1) * i1 if d1 != 0 else np.inf
                exit2 = ((l2 + width if up2 else l2) - o2) * i2 if d2 != 0 else np.inf
                ahead = max(min(exit0, exit1, exit2), t)
                if slot >= 0:
                    row = base + (slot >> 1)
                    length = ahead - t
                    depth = min(rows[row, SIGMA] * length, 39.0)
                    step = int(depth * _PER)
                    rest = depth - step * (1 / _PER)
                    kept = _FALL[step] * (1 - rest * (1 - rest * (0.5 - rest * (1 / 6))))
                    behind = through * kept
                    if behind < OPAQUE:
                        behind = 0.0  # the last cell takes all that is left
                    weight = through - behind
                    red += weight * rows[row, 0]
                    green += weight * rows[row, 1]
                    blue += weight * rows[row, 2]
                    through = behind
                    hits.row[count], hits.length[count], hits.through[count] = row, length, through
                    count += 1
                    if through == 0:
                        break
                t = ahead
                if exit0 <= exit1 and exit0 <= exit2:
                    x = l0 + width if up0 else l0 - 1
                    if wide:
                        y, z = within(o1 + t * d1, l1, l1 + 1), within(o2 + t * d2, l2, l2 + 1)
                elif exit1 <= exit2:
                    y = l1 + width if up1 else l1 - 1
                    if wide:
                        x, z = within(o0 + t * d0, l0, l0 + 1), within(o2 + t * d2, l2, l2 + 1)
                else:
                    z = l2 + width if up2 else l2 - 1
                    if wide:
                        x, y = within(o0 + t * d0, l0, l0 + 1), within(o1 + t * d1, l1, l1 + 1)
                if x >> 3 != b0 or y >> 3 != b1 or z >> 3 != b2:
                    break
            if through == 0:
                break
        if not (0 <= x < edge and 0 <= y < edge and 0 <= z < edge):
            break
    seen[0] += red + through * background[0]
    seen[1] += green + through * background[1]
    seen[2] += blue + through * background[2]
    seen[3] += 1 - through
    return count


@compiled()
def _back(
    batch: Batch,
    task: Whole,
    hits: Hits,
    first: Whole,
    last: int,
    off: Floats,
    targets: Singles,
    pixel: int,
    background: Singles,
    alpha_weight: float,
    point_weight: float,
) -> None:
    """Replays a ray's hits from the last to the first; off (4,): what its pixel lacks, of colours and of alpha."""
    rows = batch.rows[task]
    left = np.float64(hits.through[last - 1]) if last > first else 1.0
    s0, s1, s2 = left * background[0], left * background[1], left * background[2]
    r0, r1, r2, ra = off[0], off[1], off[2], alpha_weight * off[3] * left
    g0, g1, g2 = targets[pixel, 0], targets[pixel, 1], targets[pixel, 2]
    blame = abs(r0) + abs(r1) + abs(r2)
    for hit in range(last - 1, first - 1, -1):
        row, length, behind = hits.row[hit], np.float64(hits.length[hit]), np.float64(hits.through[hit])
        weight = (np.float64(hits.through[hit - 1]) if hit > first else 1.0) - behind
        c0, c1, c2 = np.float64(rows[row, 0]), np.float64(rows[row, 1]), np.float64(rows[row, 2])
        j0, j1, j2 = length * (behind * c0 - s0), length * (behind * c1 - s1), length * (behind * c2 - s2)
        ja = length * left
        s0, s1, s2 = s0 + weight * c0, s1 + weight * c1, s2 + weight * c2
        rows[row, COLOUR_SUM] += weight * (r0 + point_weight * (g0 - c0))
        rows[row, COLOUR_SUM + 1] += weight * (r1 + point_weight * (g1 - c1))
        rows[row, COLOUR_SUM + 2] += weight * (r2 + point_weight * (g2 - c2))
        rows[row, WEIGHT] += weight
        rows[row, DENSITY_SUM] += j0 * r0 + j1 * r1 + j2 * r2 + length * ra
        rows[row, CURVATURE] += j0 * j0 + j1 * j1 + j2 * j2 + alpha_weight * ja * ja
        rows[row, MOST] = max(rows[row, MOST], weight)
        rows[row, BLAME] += weight * blame
