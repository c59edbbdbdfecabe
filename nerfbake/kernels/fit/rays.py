"""March the rays of one view through the bricks, and accumulate for each cell the change that its pixels require."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.fit.bricks import (
    BLAME,
    COLOUR_SUM,
    CURVATURE,
    DENSITY_SUM,
    MOST,
    SIGMA,
    UNMET,
    WEIGHT,
    BrickGrid,
    TaskBuffers,
    Whole,
)
from nerfbake.kernels.fit.colours import fill_brick_rows, new_colour_buffer
from nerfbake.kernels.fit.corners import between, corner_rows, density_of_raw, fill_corner_rows
from nerfbake.kernels.fit.hull import part_between
from nerfbake.kernels.jit import borrowed, compiled, next_task, part_of
from nerfbake.kernels.march.lines import cell_at, containing_cell, exits, line_of, next_cell
from nerfbake.kernels.maths.elementary import exp
from nerfbake.kernels.parallel import taken_in_turn

SUMS = 7
OPAQUE = 0.01  # transmittance below which a ray stops
_MARGIN = 0.02  # on the scale of places along a ray: light this close to a known surface is right
_BEHIND = 0.03  # most that light behind the margin counts: depths at edges are often those of what is nearer
_NEAR = 64  # pixels over which a mean residual runs, as many as in a tile
_PER = 64  # table entries for one unit of optical depth
_FALL = exp(-np.arange(40 * _PER) / _PER)


class FitView(NamedTuple):
    """The target of one view.

    eye (3,) and directions (pixels rays, 3) float32, unit vectors, in the world; the rays of a pixel are consecutive.
    targets (pixels, 4): colour over the background, and alpha. background (3,). alpha_weight and point_weight: weights
    of alpha, and of the colour of each single cell, relative to that of a pixel's colour. distortion: weight of the
    distortion loss, which pulls the weights of a ray to one place; 0: none. It measures distances along the ray on a
    scale that is linear near the camera and ends at infinity; focus: its middle, in world units. most: the largest
    residual of a channel that counts in full; those of other pixels are scaled down to it. most_mean: the largest mean
    residual of neighbouring pixels that counts in full; where it is larger, their residuals are scaled down by as much.
    depth: weight of the depth loss, which counts only together with the distortion loss, and on its scale: it pulls the
    light of a ray to where pictures show a surface. distances (pixels,): of that surface from the eye, 0 if it is not
    known; or (0,) without this loss.
    """

    eye: Floats
    directions: Singles
    targets: Singles
    background: Singles
    alpha_weight: float
    point_weight: float
    distortion: float
    focus: float
    most: float
    most_mean: float
    depth: float
    distances: Singles


class TaskState(NamedTuple):
    """The buffers of one task.

    row, length, depth, through: for each cell that the rays of a pixel hit, its row, the length of the ray in it, where
    it lies along the ray (see _depth()), and the transmittance behind it. If densities are interpolated, middle (., 4):
    the middle of the ray's way through the cell, and the slope of the density there; corners (., 2): the number of the
    cell, and the first row of the sums of its brick's corners. seen (4,): the sum of the rays'
    colours and alphas, later the residual of the pixel. mean (3,): the running mean of the residuals. room: a buffer of
    colours.new_colour_buffer(). place (S, 3): the camera, in cells of each shell. enter, leave (S,): where the ray
    enters and leaves each cube.
    """

    row: npt.NDArray[np.int32]
    length: Singles
    depth: Singles
    through: Singles
    middle: Singles
    corners: npt.NDArray[np.int32]
    seen: Floats
    mean: Floats
    room: Singles
    place: Floats
    enter: Floats
    leave: Floats


def march_view(bricks: BrickGrid, batch: TaskBuffers, view: FitView, sums: Floats) -> None:
    """Fill the batch with the changes that the pixels require of the cells.

    sums (tasks, SUMS): the sum of the squared residuals of the colours; and for each channel of the pixels with alpha 1
    the sum of target times rendered colour, and of the rendered colour squared.
    """
    # The length of a tuple belongs to its type, so the kernel is compiled for constant and for interpolated densities.
    # With a check for each cell, constant densities would take 45 % longer.
    _march_view(bricks, batch, view, (1,) if bricks.smooth else (), sums)


# Arrays are passed in tuples and read from there: for an array that is an argument, or a view of another array, each
# call counts references, and threads wait for each other at every count. The loop over tasks is not a separate kernel:
# then everything that it calls would be compiled twice.
@taken_in_turn
@compiled()
def _march_view(
    turn: Ints,
    bricks: BrickGrid,
    batch: TaskBuffers,
    view: FitView,
    kind: tuple[int, ...],
    sums: Floats,
) -> None:
    """Do tasks, which take different times: each is a part of the picture."""
    bricks, batch, view = borrowed((bricks, batch, view))
    tasks, pixels = batch.base.shape[0], len(view.targets)
    rays = len(view.directions) // max(pixels, 1)
    most, smooth = 4 * 8 * bricks.top.shape[0] * rays, len(kind) > 0
    own = TaskState(
        np.empty(most, np.int32),
        np.empty(most, np.float32),
        np.empty(most if view.distortion > 0 else 1, np.float32),
        np.empty(most, np.float32),
        np.empty((most if smooth else 1, 4), np.float32),
        np.empty((most if smooth else 1, 2), np.int32),
        np.zeros(4),
        np.zeros(3),
        new_colour_buffer((len(bricks.values) // bricks.first[-1] - 1) // 3),
        (view.eye - bricks.low) / bricks.size,
        np.empty(len(bricks.low)),
        np.empty(len(bricks.low)),
    )
    ends = np.zeros(rays + 1, np.int64)
    while True:
        task = next_task(turn)
        if task >= tasks:
            break
        batch.used[task] = 0
        batch.base[task, :] = UNMET
        sums[task, :] = 0
        own.mean[:] = 0
        begin, end = part_of(pixels, task, tasks)
        for pixel in range(begin, end):
            own.seen[:] = 0
            for ray in range(rays):
                ends[ray + 1] = _march_ray(bricks, batch, task, view, own, smooth, pixel * rays + ray, ends[ray])
            for k in range(4):
                own.seen[k] = view.targets[pixel, k] - own.seen[k] / rays
            sums[task, 0] += own.seen[0] * own.seen[0] + own.seen[1] * own.seen[1] + own.seen[2] * own.seen[2]
            if view.targets[pixel, 3] >= 1:
                for k in range(3):
                    target = np.float64(view.targets[pixel, k])
                    rendered = target - own.seen[k]
                    sums[task, 1 + k] += target * rendered
                    sums[task, 4 + k] += rendered * rendered
            _limit_residual(view, own)
            for ray in range(rays):
                _accumulate_back(bricks, batch, task, view, own, smooth, pixel, ends[ray], ends[ray + 1])


@compiled(merged=True)
def _march_ray(
    bricks: BrickGrid,
    batch: TaskBuffers,
    task: Whole,
    view: FitView,
    own: TaskState,
    smooth: bool,
    ray: Whole,
    count: Whole,
) -> Whole:
    """March a ray: add its colour and alpha to `seen`, append its hits, and return the number of all hits so far.

    The ray meets each shell at most twice: before and behind the smaller cubes.
    """
    edge, shells = 8 * bricks.top.shape[1], len(bricks.low)
    through, red, green, blue = 1.0, 0.0, 0.0, 0.0
    # The shells from the outermost to the innermost one that the ray enters, and back.
    deepest = shells
    for shell in range(shells - 1, -1, -1):
        own.enter[shell], own.leave[shell] = _part_in_cube(bricks, own, view, ray, shell)
        if own.enter[shell] >= own.leave[shell]:
            break
        deepest = shell
    for part in range(2 * (shells - deepest) - 1 if deepest < shells else 0):
        inward = part < shells - 1 - deepest
        shell = shells - 1 - part if inward else 2 * deepest + part - shells + 1
        t = own.enter[shell] if inward or shell == deepest else own.leave[shell - 1]
        end = own.enter[shell - 1] if inward else own.leave[shell]
        if t >= end:
            continue
        d0, d1, d2 = (
            view.directions[ray, 0] / bricks.size[shell, 0],
            view.directions[ray, 1] / bricks.size[shell, 1],
            view.directions[ray, 2] / bricks.size[shell, 2],
        )
        o0, o1, o2 = own.place[shell, 0], own.place[shell, 1], own.place[shell, 2]
        line = line_of((o0, o1, o2), (d0, d1, d2))
        x, y, z = cell_at(line, t, (0, 0, 0), (edge - 1, edge - 1, edge - 1))
        exact = 3  # after a wide cell, the only axis along which the last bit of the place is valid; 3: all axes
        while t < end:
            b0, b1, b2 = x >> 3, y >> 3, z >> 3
            brick = np.int64(bricks.top[shell * bricks.top.shape[1] + b0, b1, b2])
            # Of the brick: the row of its first cell, this cell, the number of cells, and half the rows of corners.
            base, first, cells, more = np.int64(-1), np.int64(0), np.int64(0), np.int64(0)
            if brick >= 0:
                base = np.int64(batch.base[task, brick])
                if smooth:
                    first, more = np.int64(bricks.first[brick]), corner_rows(bricks, brick)
                    cells = np.int64(bricks.first[brick + 1]) - first
                if base == UNMET:
                    at = b0, b1, b2
                    base = fill_brick_rows(bricks, batch, task, brick, shell, at, view.eye, own.room, 2 * more)
                    if smooth and base >= 0:
                        fill_corner_rows(bricks, batch, task, brick, base + cells)
            if base < 0:
                # Skip the empty bricks up to the known distance, in all directions.
                exact = 3
                away: Whole = max(-brick, 1)
                low, width = ((b0 - away + 1) << 3, (b1 - away + 1) << 3, (b2 - away + 1) << 3), (2 * away - 1) << 3
                crossings = exits(low, width, line)
                t = max(min(crossings), t)
                (x, y, z), _ = next_cell(low, width, crossings, line, t)
            else:
                while True:
                    slot = np.int64(bricks.slots[brick, (x & 7) << 6 | (y & 7) << 3 | z & 7])
                    if exact < 3 and slot & 1 == 0:
                        if exact != 0:
                            x = containing_cell(o0 + t * d0, x & ~1, x | 1)
                        if exact != 1:
                            y = containing_cell(o1 + t * d1, y & ~1, y | 1)
                        if exact != 2:
                            z = containing_cell(o2 + t * d2, z & ~1, z | 1)
                        exact = 3
                        slot = np.int64(bricks.slots[brick, (x & 7) << 6 | (y & 7) << 3 | z & 7])
                    wide: Whole = slot & 1
                    l0, l1, l2, width = x & ~wide, y & ~wide, z & ~wide, 1 + wide
                    exit0, exit1, exit2 = exits((l0, l1, l2), width, line)
                    ahead = max(min(exit0, exit1, exit2), t)
                    if slot >= 0:
                        row = base + (slot >> 1)
                        length = ahead - t
                        sigma = float(batch.rows[task, row, SIGMA])
                        if smooth:
                            middle = t + 0.5 * length
                            place = o0 + middle * d0 - l0, o1 + middle * d1 - l1, o2 + middle * d2 - l2
                            own.corners[count, 0], own.corners[count, 1] = first + (slot >> 1), base + cells + more
                            per_width = 1 / bricks.width[shell]
                            sigma = _density_at(bricks, batch, task, own, base + cells, count, place, per_width)
                        depth = min(sigma * length, 39.0)
                        step = int(depth * _PER)
                        rest = depth - step * (1 / _PER)
                        kept = _FALL[step] * (1 - rest * (1 - rest * (0.5 - rest * (1 / 6))))
                        behind = through * kept
                        if behind < OPAQUE:
                            behind = 0.0  # the last cell absorbs all remaining light
                        weight = through - behind
                        red += weight * batch.rows[task, row, 0]
                        green += weight * batch.rows[task, row, 1]
                        blue += weight * batch.rows[task, row, 2]
                        through = behind
                        own.row[count], own.length[count], own.through[count] = row, length, through
                        if view.distortion > 0:
                            own.depth[count] = _depth(t + 0.5 * length, view.focus)
                        count += 1
                        if through == 0:
                            break
                    t = ahead
                    if exit0 <= exit1 and exit0 <= exit2:
                        x, axis = l0 + width if d0 > 0 else l0 - 1, 0
                    elif exit1 <= exit2:
                        y, axis = l1 + width if d1 > 0 else l1 - 1, 1
                    else:
                        z, axis = l2 + width if d2 > 0 else l2 - 1, 2
                    exact = axis if wide else 3
                    if x >> 3 != b0 or y >> 3 != b1 or z >> 3 != b2:
                        break
                if through == 0:
                    break
            if not (0 <= x < edge and 0 <= y < edge and 0 <= z < edge):
                break
        if through == 0:
            break
    own.seen[0] += red + through * view.background[0]
    own.seen[1] += green + through * view.background[1]
    own.seen[2] += blue + through * view.background[2]
    own.seen[3] += 1 - through
    return count


@compiled(merged=True)
def _density_at(
    bricks: BrickGrid,
    batch: TaskBuffers,
    task: Whole,
    own: TaskState,
    raw: Whole,
    hit: Whole,
    at: Any,
    per_width: float,
) -> Any:
    """Return the interpolated density per world unit at a place in a cell, and record what its slopes need.

    raw: the first row of the raw densities of the brick's corners. per_width: the inverse width of a cell.
    """
    x, y, z = min(max(at[0], 0.0), 1.0), min(max(at[1], 0.0), 1.0), min(max(at[2], 0.0), 1.0)
    cell = np.int64(own.corners[hit, 0])
    corners = (
        _of_corner(bricks, batch, task, cell, 0, raw),
        _of_corner(bricks, batch, task, cell, 1, raw),
        _of_corner(bricks, batch, task, cell, 2, raw),
        _of_corner(bricks, batch, task, cell, 3, raw),
        _of_corner(bricks, batch, task, cell, 4, raw),
        _of_corner(bricks, batch, task, cell, 5, raw),
        _of_corner(bricks, batch, task, cell, 6, raw),
        _of_corner(bricks, batch, task, cell, 7, raw),
    )
    density, slope = density_of_raw(between(corners, x, y, z))
    own.middle[hit, 0], own.middle[hit, 1], own.middle[hit, 2] = x, y, z
    own.middle[hit, 3] = slope * per_width
    return density * per_width


@compiled(merged=True)
def _of_corner(bricks: BrickGrid, batch: TaskBuffers, task: Whole, cell: Whole, corner: int, first: Whole) -> Any:
    """Return the value of a cell's corner in the rows from `first` on, see corner_rows()."""
    k = np.int64(bricks.corners.of_cell[cell, corner])
    return batch.rows[task, first + (k >> 4), k & 15]


@compiled(merged=True)
def _add_slope(
    bricks: BrickGrid, batch: TaskBuffers, task: Whole, own: TaskState, smooth: bool, hit: Whole, asked: float
) -> None:
    """Add the slope of the loss by the density at a hit to the sums of its cell, or of the cell's corners."""
    if not smooth:
        batch.rows[task, own.row[hit], DENSITY_SUM] += asked
        return
    cell, first = np.int64(own.corners[hit, 0]), np.int64(own.corners[hit, 1])
    x, y, z = np.float64(own.middle[hit, 0]), np.float64(own.middle[hit, 1]), np.float64(own.middle[hit, 2])
    asked *= own.middle[hit, 3]
    below, above = asked * (1 - x), asked * x
    for side in range(2):
        part = above if side else below
        low, high = part * (1 - y), part * y
        _add_to_corner(bricks, batch, task, cell, 4 * side, first, low * (1 - z))
        _add_to_corner(bricks, batch, task, cell, 4 * side + 1, first, low * z)
        _add_to_corner(bricks, batch, task, cell, 4 * side + 2, first, high * (1 - z))
        _add_to_corner(bricks, batch, task, cell, 4 * side + 3, first, high * z)


@compiled(merged=True)
def _add_to_corner(
    bricks: BrickGrid, batch: TaskBuffers, task: Whole, cell: Whole, corner: Whole, first: Whole, asked: float
) -> None:
    k = np.int64(bricks.corners.of_cell[cell, corner])
    batch.rows[task, first + (k >> 4), k & 15] += asked


@compiled(merged=True)
def _limit_residual(view: FitView, own: TaskState) -> None:
    """Update the running mean of the residuals, and scale a residual down if it, or the mean, is too large."""
    for k in range(3):
        own.mean[k] += (own.seen[k] - own.mean[k]) * (1 / _NEAR)
    largest, mean, scale = 0.0, 0.0, 1.0
    for k in range(3):
        largest, mean = max(largest, abs(own.seen[k])), max(mean, abs(own.mean[k]))
    if largest > view.most:
        scale = view.most / largest
    if mean > view.most_mean:
        scale = min(scale, view.most_mean / mean)
    for k in range(3):
        own.seen[k] *= scale


@compiled(merged=True)
def _part_in_cube(bricks: BrickGrid, own: TaskState, view: FitView, ray: Whole, shell: Whole) -> Any:
    """Return where the ray enters and leaves the cube around a shell."""
    edge, start, end = 8 * bricks.top.shape[1], 0.0, np.inf
    for axis in range(3):
        step = view.directions[ray, axis] / bricks.size[shell, axis]
        start, end = part_between(own.place[shell, axis], 1 / step if step != 0 else np.inf, edge, start, end)
    return start, end


@compiled(merged=True)
def _depth(t: float, focus: float) -> float:
    """Return a place along a ray, -2 at the camera to 2 at infinity; near `focus` about log(t / focus)."""
    return 2 * (t - focus) / (t + focus)


@compiled(merged=True)
def _away(apart: float) -> float:
    """Return how wrong light is that comes from so far behind a known surface, or before it (negative).

    Light before a surface is certainly wrong. What is behind may be right at an edge, so it counts little.
    """
    if apart < 0:
        return max(-apart - _MARGIN, 0.0)
    return min(max(apart - _MARGIN, 0.0), _BEHIND)


@compiled(merged=True)
def _accumulate_back(
    bricks: BrickGrid,
    batch: TaskBuffers,
    task: Whole,
    view: FitView,
    own: TaskState,
    smooth: bool,
    pixel: Whole,
    first: Whole,
    last: Whole,
) -> None:
    """Replay the hits of a ray from the last to the first. `seen`: the residual of its pixel, in colour and alpha.

    The distortion loss is sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 l_i with the weights w, the places m, and the
    lengths l on the scale of the places. Source: Mip-NeRF 360 (Barron et al., 2022), equation 15. The depth loss is
    sum_i w_i _away(m_i - m) with the place m of the known surface.
    """
    left = np.float64(own.through[last - 1]) if last > first else 1.0
    # The sums of the weights and of weight times place over the hits ahead, and the same over those behind.
    ahead_weight, ahead_moment, before = 1 - left, 0.0, 1.0
    if view.distortion > 0:
        for hit in range(first, last):
            ahead_moment += (before - np.float64(own.through[hit])) * own.depth[hit]
            before = np.float64(own.through[hit])
    behind_weight, behind_moment, behind_slope, per_focus = 0.0, 0.0, 0.0, 1 / (4 * view.focus)
    known, surface, behind_away = False, 0.0, 0.0
    if view.distortion > 0 and view.depth > 0 and view.distances[pixel] > 0:
        known, surface = True, _depth(np.float64(view.distances[pixel]), view.focus)
    s0, s1, s2 = left * view.background[0], left * view.background[1], left * view.background[2]
    r0, r1, r2, ra = own.seen[0], own.seen[1], own.seen[2], view.alpha_weight * own.seen[3] * left
    g0, g1, g2 = view.targets[pixel, 0], view.targets[pixel, 1], view.targets[pixel, 2]
    blame = abs(r0) + abs(r1) + abs(r2)
    for hit in range(last - 1, first - 1, -1):
        row, length, behind = own.row[hit], np.float64(own.length[hit]), np.float64(own.through[hit])
        weight = (np.float64(own.through[hit - 1]) if hit > first else 1.0) - behind
        c0, c1 = np.float64(batch.rows[task, row, 0]), np.float64(batch.rows[task, row, 1])
        c2 = np.float64(batch.rows[task, row, 2])
        j0, j1, j2 = length * (behind * c0 - s0), length * (behind * c1 - s1), length * (behind * c2 - s2)
        ja = length * left
        s0, s1, s2 = s0 + weight * c0, s1 + weight * c1, s2 + weight * c2
        batch.rows[task, row, COLOUR_SUM] += weight * (r0 + view.point_weight * (g0 - c0))
        batch.rows[task, row, COLOUR_SUM + 1] += weight * (r1 + view.point_weight * (g1 - c1))
        batch.rows[task, row, COLOUR_SUM + 2] += weight * (r2 + view.point_weight * (g2 - c2))
        batch.rows[task, row, WEIGHT] += weight
        asked = j0 * r0 + j1 * r1 + j2 * r2 + length * ra
        if view.distortion > 0:
            depth = np.float64(own.depth[hit])
            ahead_weight, ahead_moment = ahead_weight - weight, ahead_moment - weight * depth
            scale = (2 - depth) * (2 - depth) * per_focus  # the slope of the places
            slope = 2 * (depth * (ahead_weight - behind_weight) - ahead_moment + behind_moment)
            slope += 2 / 3 * weight * length * scale
            asked -= view.distortion * length * (behind * slope - behind_slope)
            behind_slope += weight * slope
            behind_weight, behind_moment = behind_weight + weight, behind_moment + weight * depth
            if known:
                away = _away(depth - surface)
                asked -= view.depth * length * (behind * away - behind_away)
                behind_away += weight * away
        _add_slope(bricks, batch, task, own, smooth, hit, asked)
        squares = j0 * j0 + j1 * j1 + j2 * j2 + view.alpha_weight * ja * ja
        if smooth:
            squares *= own.middle[hit, 3] * own.middle[hit, 3]
        batch.rows[task, row, CURVATURE] += squares
        batch.rows[task, row, MOST] = max(batch.rows[task, row, MOST], weight)
        batch.rows[task, row, BLAME] += weight * blame
