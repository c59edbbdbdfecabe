"""Sum the changes that the tasks accumulated for the cells, in a fixed order, and apply a step to each cell."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.fit.bricks import (
    BLAME,
    COLOUR_SUM,
    CURVATURE,
    DENSITY_SUM,
    MOST,
    SIZE,
    WEIGHT,
    BrickGrid,
    CornerGrid,
    TaskBuffers,
    Whole,
)
from nerfbake.kernels.fit.colours import evaluate_basis, new_colour_buffer
from nerfbake.kernels.fit.corners import LEAST_RAW, MOST_RAW, corner_rows
from nerfbake.kernels.jit import borrowed, compiled, next_task, part_of
from nerfbake.kernels.parallel import on_every_core, taken_in_turn

DECAY = 0.9  # of the moving means
FADE = 0.95  # of the largest weight, at every view that hits the cell
CORNER_RATE = 4.0  # of the rate of the densities of cells (docs/tuning.md)
_CURVATURE_FLOOR, _WEIGHT_FLOOR = 1e-3, 1e-2
_SLOPE_FLOOR = 0.15  # of the sigmoid, whose slope is at most a quarter
_SUMS = 8  # numbers of a row that are summed, from COLOUR_SUM on
_BLOCK = 32  # places of bricks that a core processes before it takes the next block


class LearningRates(NamedTuple):
    """The rates of one step.

    density, colour: their rates. parts, ridge (B,): each coefficient's share of a step, and its ridge. rays: per pixel.
    """

    density: float
    colour: float
    parts: Singles
    ridge: Singles
    rays: float


def take_steps(
    bricks: BrickGrid, batch: TaskBuffers, eye: Floats, means: Singles, seen: Singles, steps: LearningRates
) -> None:
    """Step the values of all cells that the batch has hit. Source of the steps: docs/fitting.md, "How it is fitted".

    means (n, 2): moving means of curvature and of weight, 0 for cells that were never hit. seen (n, 2): the largest
    weight that a ray gave the cell, and the sum of weight times the residual of its pixels. Both are updated. If
    densities are interpolated, the raw densities of the corners are stepped instead of the densities.
    """
    _step_cells(bricks, batch, eye, means, seen, steps)
    if bricks.smooth:
        step_corners(bricks.corners, steps.density)


@taken_in_turn
@compiled()
def _step_cells(
    turn: Ints,
    bricks: BrickGrid,
    batch: TaskBuffers,
    eye: Floats,
    means: Singles,
    seen: Singles,
    steps: LearningRates,
) -> None:
    bricks, batch, eye, means, seen, steps = borrowed((bricks, batch, eye, means, seen, steps))
    r, places, B, smooth = bricks.top.shape[1], bricks.top.size, len(steps.ridge), len(bricks.corners.raw) > 0
    sums, room = np.empty((_SUMS + 3, SIZE), np.float32), new_colour_buffer(B)
    while True:
        block = next_task(turn)
        if block * _BLOCK >= places:
            break
        for place in range(block * _BLOCK, min((block + 1) * _BLOCK, places)):
            shell, at0, at1, at2 = place // (r * r * r), place // (r * r) % r, place // r % r, place % r
            brick = np.int64(bricks.top[shell * r + at0, at1, at2])
            if brick < 0:
                continue
            begin, count = np.int64(bricks.first[brick]), np.int64(bricks.first[brick + 1] - bricks.first[brick])
            if not _sum_tasks(batch, brick, count, sums):
                continue
            start = (3 * B + 1) * begin
            if smooth:
                _sum_corners(bricks, batch, brick, sums, np.float32(1 / steps.rays))
            else:
                _move_density(
                    bricks.values,
                    start + 3 * B * count,
                    bricks.places,
                    bricks.width[shell],
                    begin,
                    count,
                    sums,
                    means,
                    steps,
                )
            _update_seen(sums, seen, begin, count, np.float32(1 / steps.rays))
            s0, s1, s2 = bricks.size[shell, 0], bricks.size[shell, 1], bricks.size[shell, 2]
            x = np.float32(bricks.low[shell, 0] + 8 * at0 * s0 - eye[0])
            y = np.float32(bricks.low[shell, 1] + 8 * at1 * s1 - eye[1])
            z = np.float32(bricks.low[shell, 2] + 8 * at2 * s2 - eye[2])
            dx, dy, dz = np.float32(s0), np.float32(s1), np.float32(s2)
            evaluate_basis(bricks.places, begin, count, x, y, z, dx, dy, dz, room)
            _scale_sums(
                begin, count, sums, means, np.float32(1 / steps.rays), np.float32(steps.colour), room, steps.parts
            )
            for channel in range(3):
                _move_colour(
                    bricks.values,
                    start + channel * B * count,
                    count,
                    sums,
                    channel,
                    steps.parts,
                    steps.ridge,
                    np.float32(steps.colour),
                    room,
                )


@compiled()
def _sum_tasks(batch: TaskBuffers, brick: Whole, count: Whole, sums: Singles) -> bool:
    """Sum the rows of a brick's cells over the tasks, in the order of the tasks; append the colours of the cells.

    Returns False if no task has hit the brick.
    """
    met = False
    for task in range(batch.base.shape[0]):
        base = np.int64(batch.base[task, brick])
        if base < 0:
            continue
        _add_rows(batch.rows, task, base, count, met, sums)
        met = True
    return met


# Indices below are unsigned: numba checks signed ones for being negative, which also prevents vectorisation.
@compiled()
def _add_rows(rows: Singles, task: Whole, base: Whole, count: Whole, met: bool, sums: Singles) -> None:
    start = np.uint64(base)
    if not met:
        for cell in range(np.uint64(count)):
            for k in range(3):
                sums[_SUMS + k, cell] = rows[task, start + cell, k]
            for k in range(_SUMS):
                sums[k, cell] = rows[task, start + cell, COLOUR_SUM + k]
        return
    most = MOST - COLOUR_SUM
    for cell in range(np.uint64(count)):
        for k in range(_SUMS):
            if k != most:
                sums[k, cell] += rows[task, start + cell, COLOUR_SUM + k]
        sums[most, cell] = max(sums[most, cell], rows[task, start + cell, MOST])


@compiled()
def _move_density(
    values: Singles,
    start: Whole,
    places: Any,
    width: float,
    first: Whole,
    count: Whole,
    sums: Singles,
    means: Singles,
    steps: LearningRates,
) -> None:
    one, decay, fresh = np.float32(1), np.float32(DECAY), np.float32(1 - DECAY)
    floor, rate, most = np.float32(_CURVATURE_FLOOR), np.float32(steps.density), np.float32(MOST_RAW)
    value, row, per_width, rays = np.uint64(start), np.uint64(first), np.float32(1 / width), np.float32(1 / steps.rays)
    for cell in range(np.uint64(count)):
        part = per_width * (np.float32(0.5) if places[row + cell] & 1 else one)
        curvature = sums[CURVATURE - COLOUR_SUM, cell] * rays * part * part
        asked = sums[DENSITY_SUM - COLOUR_SUM, cell] * rays * part
        old = means[row + cell, 0]
        mean = decay * old + fresh * curvature if old > 0 else curvature
        quotient = min(max(asked / (mean + floor), -one), one)
        moved = min(max(values[value + cell] + rate * quotient, np.float32(0)), most)
        means[row + cell, 0] = mean if curvature > 0 else old
        values[value + cell] = moved if curvature > 0 else values[value + cell]


@compiled()
def _sum_corners(bricks: BrickGrid, batch: TaskBuffers, brick: Whole, sums: Singles, rays: Any) -> None:
    """Add up the sums of a brick's corners over the tasks, in their order. sums: those of the cells."""
    first, count = np.int64(bricks.first[brick]), np.int64(bricks.first[brick + 1] - bricks.first[brick])
    start, rows = np.int64(bricks.corners.first[brick]), corner_rows(bricks, brick)
    corners = np.uint64(bricks.corners.first[brick + 1] - start)
    for task in range(batch.base.shape[0]):
        base = np.int64(batch.base[task, brick])
        if base < 0:
            continue
        held = np.uint64(base + count + rows)
        for k in range(corners):
            row, number = held + (k >> np.uint64(4)), k & np.uint64(15)
            bricks.corners.asked[np.uint64(start) + k] += batch.rows[task, row, number] * rays
    for cell in range(count):
        curvature = sums[CURVATURE - COLOUR_SUM, cell] * rays * np.float32(1 / 8)
        if curvature > 0:
            for corner in range(8):
                bricks.corners.curvature[start + bricks.corners.of_cell[first + cell, corner]] += curvature


@on_every_core
@compiled()
def step_corners(core: int, cores: int, corners: CornerGrid, rate: float) -> None:
    """Step the raw densities by the sums of the entries, and clear these."""
    begin, end = part_of(len(corners.raw), core, cores)
    for corner in range(begin, end):
        asked, curvature = 0.0, 0.0
        for k in range(corners.back_first[corner], corners.back_first[corner + 1]):
            entry = corners.back[k]
            asked, curvature = asked + corners.asked[entry], curvature + corners.curvature[entry]
            corners.asked[entry] = 0
            corners.curvature[entry] = 0
        if curvature > 0:
            old = np.float64(corners.mean[corner])
            mean = DECAY * old + (1 - DECAY) * curvature if old > 0 else curvature
            quotient = min(max(asked / (mean + _CURVATURE_FLOOR), -1.0), 1.0)
            corners.mean[corner] = mean
            moved = np.float64(corners.raw[corner]) + CORNER_RATE * rate * quotient
            corners.raw[corner] = min(max(moved, LEAST_RAW), MOST_RAW)


@compiled()
def _update_seen(sums: Singles, seen: Singles, first: Whole, count: Whole, rays: Any) -> None:
    row = np.uint64(first)
    for cell in range(np.uint64(count)):
        if sums[CURVATURE - COLOUR_SUM, cell] > 0:
            seen[row + cell, 0] = max(seen[row + cell, 0] * np.float32(FADE), sums[MOST - COLOUR_SUM, cell])
            seen[row + cell, 1] += sums[BLAME - COLOUR_SUM, cell] * rays


@compiled()
def _scale_sums(
    first: Whole, count: Whole, sums: Singles, means: Singles, rays: Any, rate: Any, room: Singles, parts: Singles
) -> None:
    """Prepare the steps of the colours.

    room[0]: each cell's weight relative to its mean weight; room[1]: the factor that turns its sums into steps.
    """
    row, one, decay, fresh = np.uint64(first), np.float32(1), np.float32(DECAY), np.float32(1 - DECAY)
    for cell in range(np.uint64(count)):
        room[1, cell] = np.float32(0)
    for k in range(len(parts)):
        for cell in range(np.uint64(count)):
            room[1, cell] += parts[k] * room[4 + k, cell] * room[4 + k, cell]
    for cell in range(np.uint64(count)):
        weight = sums[WEIGHT - COLOUR_SUM, cell] * rays
        old = means[row + cell, 1]
        mean = decay * old + fresh * weight if old > 0 else weight
        means[row + cell, 1] = mean if weight > 0 else old
        scale = one / (mean + np.float32(_WEIGHT_FLOOR))
        room[0, cell] = weight * scale
        room[1, cell] = rays * scale * rate / room[1, cell] if weight > 0 else np.float32(0)


@compiled()
def _move_colour(
    values: Singles,
    first: Whole,
    count: Whole,
    sums: Singles,
    channel: int,
    parts: Singles,
    ridge: Singles,
    rate: Any,
    room: Singles,
) -> None:
    start, cells, one = np.uint64(first), np.uint64(count), np.float32(1)
    for cell in range(cells):
        colour = sums[_SUMS + channel, cell]
        room[2, cell] = sums[channel, cell] * room[1, cell] / max(colour * (one - colour), np.float32(_SLOPE_FLOOR))
    for k in range(len(ridge)):
        part, held = parts[k], ridge[k] * rate
        for cell in range(cells):
            value = values[start + cell]
            values[start + cell] = value + part * room[2, cell] * room[4 + k, cell] - held * room[0, cell] * value
        start += cells
