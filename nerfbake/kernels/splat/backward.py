"""Blend the tiles of a picture, and sum for each splat of a tile how the picture's error changes with it."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Singles, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.splat.blend import (
    ACROSS,
    CHUNK,
    DOWN,
    LANES,
    LEAST_TRANSMITTANCE,
    LEFT,
    LIVE,
    MOST_ALPHA,
    PIXELS,
    STRIP,
    TILE_RED,
    TileLists,
    alpha_at,
    begin_tile,
    blend_tile,
    load_chunk,
    place_of,
    row_range,
    strip_range,
)
from nerfbake.kernels.splat.project import BLUE, COLUMNS, GREEN, OPACITY, RED, X_REST, XX, XY, Y_REST, YY, X, Y
from nerfbake.kernels.splat.tiles import EDGE

# Columns of the sums. Let G be the change of the error with the exponent of a pixel's Gaussian, and dx, dy the place of
# the pixel from its centre. The sums are those of G, G dx, G dy, G dx^2, G dx dy, G dy^2, and of the splat's share of
# the pixel times the change of the error with the pixel's red, green and blue.
SUMS = 9
# More planes of a tile's state: the change of the error with the pixel's colour, and what the splats behind contribute.
ERROR_RED, ERROR_GREEN, ERROR_BLUE, REST = (np.uint64(PIXELS * k) for k in range(8, 12))
PLANES = 12


class TargetPicture(NamedTuple):
    """The picture that splats are fitted to.

    pixels (H, W, 4) uint8: colour over the background, and alpha. background (3,): sRGB, 0..1. alpha_weight: of the
    error of alpha, relative to that of a channel. partial: pixels with alpha below 255 have no effect.
    """

    pixels: npt.NDArray[np.uint8]
    background: Singles
    alpha_weight: float
    partial: bool


@on_every_core
@compiled()
def blend_back(
    core: int,
    cores: int,
    rows: Singles,
    lists: TileLists,
    columns: int,
    places: Floats,
    target: TargetPicture,
    sums: Singles,
    errors: Floats,
) -> None:
    """Write the sums (entries, SUMS) of each entry of the lists, and the error of each tile.

    errors (tiles,): the sum of the squared differences of the colours. The error that is differentiated is half of
    that, plus alpha's. For the others see blend().
    """
    state, band = np.empty(PLANES * PIXELS, np.float32), np.empty((EDGE, 2), np.float32)
    near = np.empty((CHUNK, COLUMNS), np.float32)
    lanes = np.empty(SUMS * LANES, np.float32)
    height, width = target.pixels.shape[:2]
    even = places.shape[0] == 0
    for tile in range(lists.begin + core, lists.end, cores):
        top, start = tile // columns * EDGE, tile % columns * EDGE
        high, wide = min(EDGE, height - top), min(EDGE, width - start)
        begin_tile(state, band, places, top, start, high, wide)
        begin, end = lists.starts[tile], lists.ends[tile]
        closed = blend_tile(rows, lists.entries, begin, end, state, band, near, top, start, high, wide, even)
        errors[tile] = _begin_back(state, target, top, start, high, wide)
        _sum_tile(rows, lists.entries, begin, closed, state, band, near, lanes, top, start, high, wide, even, sums)
        sums[closed:end] = 0


@compiled()
def _begin_back(state: Singles, target: TargetPicture, top: int, start: int, high: int, wide: int) -> float:
    """Compare a tile with the target, and open its pixels again. Returns the sum of the squared differences."""
    total = 0.0
    per = f32(1 / 255)
    for at in range(PIXELS):
        state[LIVE + at] = state[REST + at] = f32(0)
        state[ERROR_RED + at] = state[ERROR_GREEN + at] = state[ERROR_BLUE + at] = f32(0)
    for y in range(high):
        for x in range(wide):
            alpha = target.pixels[top + y, start + x, 3]
            if target.partial and alpha < 255:
                continue
            at = place_of(y, x)
            left = state[LEFT + at]
            rest = -f32(target.alpha_weight) * (f32(1) - left - alpha * per) * left
            for k in range(3):
                seen = state[TILE_RED + PIXELS * k + at] + left * target.background[k]
                error = seen - target.pixels[top + y, start + x, k] * per
                total += error * error
                state[ERROR_RED + PIXELS * k + at] = error
                rest += error * seen
            state[REST + at] = rest
            state[LIVE + at] = f32(1)
    return total


@compiled()
def _sum_tile(
    rows: Singles,
    entries: npt.NDArray[np.int32],
    begin: int,
    end: int,
    state: Singles,
    band: Singles,
    near: Singles,
    lanes: Singles,
    top: int,
    start: int,
    high: int,
    wide: int,
    even: bool,
    sums: Singles,
) -> None:
    """Write the sums of entries begin .. end, which blend_tile() has blended."""
    for first in range(begin, end, CHUNK):
        count = load_chunk(rows, entries, first, end, near)
        for k in range(count):
            i = np.uint64(k)
            x = (near[i, X] - f32(start)) + near[i, X_REST]
            y = (near[i, Y] - f32(top)) + near[i, Y_REST]
            xx, xy, yy, opacity = near[i, XX], near[i, XY], near[i, YY], near[i, OPACITY]
            red, green, blue = near[i, RED], near[i, GREEN], near[i, BLUE]
            for lane in range(np.uint64(lanes.size)):
                lanes[lane] = f32(0)
            first_strip, last_strip = strip_range(near, i, x, wide, even)
            for strip in range(first_strip, last_strip):
                first_row, last_row = row_range(near, i, x, y, band, strip, high, even)
                for row in range(first_row, last_row):
                    place = strip * STRIP + row * LANES
                    _sum_row(state, lanes, place, lanes.size // SUMS, x, y, xx, xy, yy, opacity, red, green, blue)
            for column in range(SUMS):
                total = f32(0)
                for lane in range(LANES):
                    total += lanes[np.uint64(column * LANES + lane)]
                sums[first + k, column] = total


@compiled(merged=True)
def _sum_row(
    state: Singles,
    lanes: Singles,
    place: int,
    count: int,
    x: np.float32,
    y: np.float32,
    xx: np.float32,
    xy: np.float32,
    yy: np.float32,
    opacity: np.float32,
    red: np.float32,
    green: np.float32,
    blue: np.float32,
) -> None:
    one, none, lane_step = f32(1), f32(0), np.uint64(LANES)
    first = np.uint64(place)
    for k in range(np.uint64(count)):
        at = first + k
        to: Any = k
        dx, dy = state[ACROSS + at] - x, state[DOWN + at] - y
        alpha = alpha_at(dx, dy, xx, xy, yy, opacity)
        live = state[LIVE + at]
        then = live * (one - alpha)
        goes_on = then >= f32(LEAST_TRANSMITTANCE)
        weight = live * alpha if goes_on else none
        error_red, error_green, error_blue = state[ERROR_RED + at], state[ERROR_GREEN + at], state[ERROR_BLUE + at]
        shown = error_red * red + error_green * green + error_blue * blue
        rest = state[REST + at] - weight * shown
        # The share of the splats behind is proportional to 1 - alpha.
        change = weight * shown - alpha * rest / (one - alpha)
        change = change if goes_on else none
        change = change if alpha < f32(MOST_ALPHA) else none
        state[REST + at] = rest
        state[LIVE + at] = then if goes_on else none
        lanes[to] += change
        to += lane_step
        lanes[to] += change * dx
        to += lane_step
        lanes[to] += change * dy
        to += lane_step
        lanes[to] += change * dx * dx
        to += lane_step
        lanes[to] += change * dx * dy
        to += lane_step
        lanes[to] += change * dy * dy
        to += lane_step
        lanes[to] += weight * error_red
        to += lane_step
        lanes[to] += weight * error_green
        to += lane_step
        lanes[to] += weight * error_blue


def entries_by_row(entries: npt.NDArray[np.int32], rows: int) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int32]]:
    """Return where the entries of each row are: row i has the entries places[firsts[i]:firsts[i + 1]]."""
    firsts, places = np.zeros(rows + 1, np.int64), np.empty(len(entries), np.int32)
    _order_by_row(entries, firsts, places)
    return firsts, places


@compiled()
def _order_by_row(entries: npt.NDArray[np.int32], firsts: npt.NDArray[np.int64], places: npt.NDArray[np.int32]) -> None:
    rows = len(firsts) - 1
    for at in range(len(entries)):
        firsts[entries[at] + 1] += 1
    for i in range(rows):
        firsts[i + 1] += firsts[i]
    cursor = firsts[:-1].copy()
    for at in range(len(entries)):
        i = entries[at]
        places[cursor[i]] = at
        cursor[i] += 1
