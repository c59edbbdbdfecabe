"""Blend the splats of each tile front to back."""

from __future__ import annotations

from math import sqrt
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.splat.project import (
    BLUE,
    COLUMNS,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
    HALF_WIDTH,
    INVERSE_DET,
    OPACITY,
    REACH,
    RED,
    SEEN,
    X_REST,
    XX,
    XY,
    Y_REST,
    YY,
    Eye,
    X,
    Y,
)
from nerfbake.kernels.splat.tiles import EDGE, PAD

MOST_ALPHA = 0.99
LEAST_TRANSMITTANCE = 1e-4  # a pixel is closed before the splat that would leave less
PIXELS = EDGE * EDGE
LANES = 8  # columns of a strip: pixels that are always computed together
STRIPS = EDGE // LANES
STRIP = LANES * EDGE  # pixels of a strip
_LONG = 3.0  # pixels: half the height from which an ellipse's rows are computed for each strip
CHUNK = 32  # splats whose rows are copied at a time, so that the CPU loads them while it computes others
# Planes of a tile's state, PIXELS numbers each, in one array: at constant distances, the compiler need not check that
# they do not overlap. A plane holds strips of 8 columns, one after the other, so that the pixels of several rows are
# contiguous. LIVE is the transmittance, or 0 for a closed pixel; LEFT is the transmittance.
LIVE, LEFT, TILE_RED, TILE_GREEN, TILE_BLUE, FAR, ACROSS, DOWN = (np.uint64(PIXELS * k) for k in range(8))
PLANES = 8


class TileLists(NamedTuple):
    """The splats of tiles begin .. end: tile k has entries[starts[k]:ends[k]], row numbers from near to far."""

    begin: int
    end: int
    starts: Ints
    ends: Ints
    entries: npt.NDArray[np.int32]


class PicturePlanes(NamedTuple):
    """A picture: colour (H, W, 3), alpha (H, W), depth (H, W), and the background (3,) behind it."""

    colour: Singles
    alpha: Singles
    depth: Singles
    background: Singles


@on_every_core
@compiled()
def blend(
    core: int,
    cores: int,
    rows: Singles,
    lists: TileLists,
    columns: int,
    eye: Eye,
    places: Floats,
    out: PicturePlanes,
) -> None:
    """Write the pixels of these tiles.

    columns: tiles of a row. places (H, W, 2): where the pixels' centres are without lens distortion, or empty.
    """
    state, band = np.empty(PLANES * PIXELS, np.float32), np.empty((EDGE, 2), np.float32)
    near = np.empty((CHUNK, COLUMNS), np.float32)
    height, width = out.alpha.shape
    even = places.shape[0] == 0
    for tile in range(lists.begin + core, lists.end, cores):
        top, start = tile // columns * EDGE, tile % columns * EDGE
        high, wide = min(EDGE, height - top), min(EDGE, width - start)
        begin_tile(state, band, places, top, start, high, wide)
        begin, end = lists.starts[tile], lists.ends[tile]
        blend_tile(rows, lists.entries, begin, end, state, band, near, top, start, high, wide, even)
        for y in range(high):
            for x in range(wide):
                _write_pixel(state, place_of(y, x), top, start, eye, out, top + y, start + x)


@compiled(merged=True)
def place_of(y: int, x: int) -> int:
    """Return the place of a pixel in a plane."""
    return x // LANES * STRIP + y * LANES + x % LANES


@compiled()
def _write_pixel(
    state: Singles, at: int, top: int, start: int, eye: Eye, out: PicturePlanes, row: int, column: int
) -> None:
    left = state[LEFT + at]
    for k in range(3):
        colour = state[TILE_RED + PIXELS * k + at] + left * out.background[k]
        out.colour[row, column, k] = min(colour, f32(1))
    alpha = f32(1) - left
    out.alpha[row, column], out.depth[row, column] = alpha, f32(0)
    if alpha > 0:
        x = (state[ACROSS + at] + start - eye.cx) / eye.fx
        y = (state[DOWN + at] + top - eye.cy) / eye.fy
        gram = eye.gram
        square = x * x * gram[0, 0] + y * y * gram[1, 1] + gram[2, 2]
        square += 2 * (x * y * gram[0, 1] + x * gram[0, 2] + y * gram[1, 2])
        out.depth[row, column] = state[FAR + at] / alpha * sqrt(square)


@compiled()
def begin_tile(state: Singles, band: Singles, places: Floats, top: int, start: int, high: int, wide: int) -> None:
    """Set the state of a tile: open pixels, and their places relative to the tile's corner.

    Pixels outside the picture are closed. band (EDGE, 2): least and largest y of each row.
    """
    for y in range(EDGE):
        for x in range(EDGE):
            at = place_of(y, x)
            inside = y < high and x < wide
            state[LIVE + at] = f32(1) if inside else f32(0)
            state[LEFT + at] = f32(1)
            state[TILE_RED + at] = state[TILE_GREEN + at] = state[TILE_BLUE + at] = state[FAR + at] = f32(0)
            state[ACROSS + at], state[DOWN + at] = f32(x + 0.5), f32(y + 0.5)
            if len(places) and inside:
                state[ACROSS + at] = places[top + y, start + x, 0] - start
                state[DOWN + at] = places[top + y, start + x, 1] - top
        band[y, 0], band[y, 1] = state[DOWN + place_of(y, 0)], state[DOWN + place_of(y, 0)]
        for x in range(wide):
            band[y, 0] = min(band[y, 0], state[DOWN + place_of(y, x)])
            band[y, 1] = max(band[y, 1], state[DOWN + place_of(y, x)])


@compiled()
def blend_tile(
    rows: Singles,
    entries: npt.NDArray[np.int32],
    begin: int,
    end: int,
    state: Singles,
    band: Singles,
    near: Singles,
    top: int,
    start: int,
    high: int,
    wide: int,
    even: bool,
) -> int:
    """Blend the splats of entries begin .. end. Returns the place of the first entry that no open pixel is left for."""
    for first in range(begin, end, CHUNK):
        if not is_open(state):
            return first
        count = load_chunk(rows, entries, first, end, near)
        for k in range(count):
            i = np.uint64(k)
            x = (near[i, X] - f32(start)) + near[i, X_REST]
            y = (near[i, Y] - f32(top)) + near[i, Y_REST]
            xx, xy, yy, opacity = near[i, XX], near[i, XY], near[i, YY], near[i, OPACITY]
            red, green, blue, depth = near[i, RED], near[i, GREEN], near[i, BLUE], near[i, DEPTH]
            first_strip, last_strip = strip_range(near, i, x, wide, even)
            for strip in range(first_strip, last_strip):
                first_row, last_row = row_range(near, i, x, y, band, strip, high, even)
                if last_row > first_row:
                    place = strip * STRIP + first_row * LANES
                    size = (last_row - first_row) * LANES
                    _blend_pixels(state, place, size, x, y, xx, xy, yy, opacity, red, green, blue, depth)
    return end


@compiled()
def load_chunk(rows: Singles, entries: npt.NDArray[np.int32], first: int, end: int, near: Singles) -> int:
    """Copy the rows of the next splats of a tile to `near` (CHUNK, COLUMNS), and return how many."""
    count = min(CHUNK, end - first)
    for k in range(count):
        i = np.uint64(entries[first + k])
        for column in range(COLUMNS):
            near[np.uint64(k), column] = rows[i, column]
    return count


@compiled(merged=True)
def strip_range(rows: Singles, i: np.uint64, x: np.float32, wide: int, even: bool) -> tuple[int, int]:
    """Return the range of strips of the tile that a splat at x may reach."""
    if not even:
        return 0, STRIPS
    half = rows[i, HALF_WIDTH] + f32(PAD)
    low, most = max(x - half - f32(0.5), f32(0)), min(x + half - f32(0.5), f32(wide - 1))
    if not low <= most:
        return 0, 0
    return int(low) // LANES, int(most) // LANES + 1


@compiled(merged=True)
def row_range(
    rows: Singles, i: np.uint64, x: np.float32, y: np.float32, band: Singles, strip: int, high: int, even: bool
) -> tuple[int, int]:
    """Return the range of rows of a strip that a splat at x, y may reach."""
    half = rows[i, HALF_HEIGHT]
    low, most = y - half, y + half
    if not even:
        first, last = high, 0
        for row in range(high):
            if band[row, 1] >= low - f32(PAD) and band[row, 0] <= most + f32(PAD):
                first, last = min(first, row), row + 1
        return first, last
    if half > f32(_LONG):
        # The ellipse between the first and the last column of the strip: where it is highest and lowest, or at the
        # column that is nearest to that.
        left = f32(strip * LANES + 0.5) - x
        right = left + f32(LANES - 1)
        xx, xy, yy = rows[i, XX], rows[i, XY], rows[i, YY]
        highest = -xy / xx * half
        up, down = min(max(-highest, left), right), min(max(highest, left), right)
        inverse_det, reach = rows[i, INVERSE_DET], rows[i, REACH] * yy
        per = f32(1) / yy
        low = y - (xy * up + sqrt(max(reach - up * up * inverse_det, f32(0)))) * per
        most = y - (xy * down - sqrt(max(reach - down * down * inverse_det, f32(0)))) * per
    low, most = max(low - f32(PAD + 0.5), f32(0)), min(most + f32(PAD - 0.5), f32(high - 1))
    if not low <= most:
        return 0, 0
    return int(low), int(most) + 1


@compiled(merged=True)
def _blend_pixels(
    state: Singles,
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
    depth: np.float32,
) -> None:
    one, none = f32(1), f32(0)
    # Indices are unsigned: numba checks signed ones for being negative, which prevents vectorisation.
    first = np.uint64(place)
    for k in range(np.uint64(count)):
        at = first + k
        alpha = alpha_at(state[ACROSS + at] - x, state[DOWN + at] - y, xx, xy, yy, opacity)
        live, left = state[LIVE + at], state[LEFT + at]
        then = live * (one - alpha)
        goes_on = then >= f32(LEAST_TRANSMITTANCE)
        weight = live * alpha if goes_on else none
        state[TILE_RED + at] += weight * red
        state[TILE_GREEN + at] += weight * green
        state[TILE_BLUE + at] += weight * blue
        state[FAR + at] += weight * depth
        state[LIVE + at] = then if goes_on else none
        state[LEFT + at] = then if goes_on else left


@compiled(merged=True)
def alpha_at(
    dx: np.float32, dy: np.float32, xx: np.float32, xy: np.float32, yy: np.float32, opacity: np.float32
) -> np.float32:
    """Return the alpha of a splat at dx, dy from its centre, or 0 if it is below SEEN."""
    exponent = f32(-0.5) * (xx * dx * dx + yy * dy * dy) - xy * dx * dy
    alpha = min(opacity * short_exp(exponent), f32(MOST_ALPHA))
    return alpha if alpha >= f32(SEEN) else f32(0)


@compiled(merged=True)
def short_exp(x: np.float32) -> np.float32:
    """e^x in float32 for x from -6 to 0, with a relative error below 3e-6; at most e^-6 for x below.

    e^(x/16) by its series about -3/16, to the 16th power: faster than tables, whose entries are loaded one by one.
    """
    t = max(min(x, f32(0)), f32(-6)) * f32(1 / 16) + f32(3 / 16)
    series = f32(1 / 120) * t + f32(1 / 24)
    series = series * t + f32(1 / 6)
    series = series * t + f32(1 / 2)
    series = series * t + f32(1)
    series = (series * t + f32(1)) * f32(0.8290291181804004)  # e^(-3/16)
    series *= series
    series *= series
    series *= series
    return series * series


@compiled()
def is_open(state: Singles) -> bool:
    """Return whether any pixel is open."""
    count: Any = 0
    for at in range(np.uint64(PIXELS)):
        count += np.int64(state[LIVE + at] > f32(0))
    return bool(count > 0)
