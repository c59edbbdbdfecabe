"""Blend the splats of each tile front to back."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.splat.project import (
    BLUE,
    DEPTH,
    GREEN,
    HALF_HEIGHT,
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
LANES = 8  # pixels of a row that are always computed together
_CHECK = 16  # splats after which a tile is checked for open pixels
# Planes of a tile's state, PIXELS numbers each, in one array: at constant distances, the compiler need not check that
# they do not overlap. LIVE is the transmittance, or 0 for a closed pixel; LEFT is the transmittance.
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


def blend(rows: Singles, lists: TileLists, columns: int, eye: Eye, places: Floats, out: PicturePlanes) -> None:
    """Write the pixels of these tiles.

    columns: tiles of a row. places (H, W, 2): where the pixels' centres are without lens distortion, or empty.
    """
    on_every_core(lambda first, step: _blend(rows, lists, columns, eye, places, out, first, step))


@compiled()
def _blend(
    rows: Singles, lists: TileLists, columns: int, eye: Eye, places: Floats, out: PicturePlanes, first: int, step: int
) -> None:
    state, band = np.empty(PLANES * PIXELS, np.float32), np.empty((EDGE, 2), np.float32)
    height, width = out.alpha.shape
    even = places.shape[0] == 0
    for tile in range(lists.begin + first, lists.end, step):
        top, start = tile // columns * EDGE, tile % columns * EDGE
        high, wide = min(EDGE, height - top), min(EDGE, width - start)
        begin_tile(state, band, places, top, start, high, wide)
        begin, end = lists.starts[tile], lists.ends[tile]
        blend_tile(rows, lists.entries, begin, end, state, band, top, start, high, wide, even)
        for y in range(high):
            for x in range(wide):
                _write_pixel(state, y * EDGE + x, top, start, eye, out, top + y, start + x)


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
    for at in range(PIXELS):
        y, x = at // EDGE, at % EDGE
        inside = y < high and x < wide
        state[LIVE + at] = f32(1) if inside else f32(0)
        state[LEFT + at] = f32(1)
        state[TILE_RED + at] = state[TILE_GREEN + at] = state[TILE_BLUE + at] = state[FAR + at] = f32(0)
        state[ACROSS + at], state[DOWN + at] = f32(x + 0.5), f32(y + 0.5)
        if len(places) and inside:
            state[ACROSS + at] = places[top + y, start + x, 0] - start
            state[DOWN + at] = places[top + y, start + x, 1] - top
    for y in range(EDGE):
        band[y, 0], band[y, 1] = state[DOWN + y * EDGE], state[DOWN + y * EDGE]
        for x in range(min(wide, EDGE)):
            band[y, 0] = min(band[y, 0], state[DOWN + y * EDGE + x])
            band[y, 1] = max(band[y, 1], state[DOWN + y * EDGE + x])


@compiled()
def blend_tile(
    rows: Singles,
    entries: npt.NDArray[np.int32],
    begin: int,
    end: int,
    state: Singles,
    band: Singles,
    top: int,
    start: int,
    high: int,
    wide: int,
    even: bool,
) -> int:
    """Blend the splats of entries begin .. end. Returns the place of the first entry that no open pixel is left for."""
    for at in range(begin, end):
        if (at - begin) % _CHECK == _CHECK - 1 and not is_open(state):
            return at
        i = np.uint64(entries[at])
        x = (rows[i, X] - f32(start)) + rows[i, X_REST]
        y = (rows[i, Y] - f32(top)) + rows[i, Y_REST]
        xx, xy, yy, opacity = rows[i, XX], rows[i, XY], rows[i, YY], rows[i, OPACITY]
        red, green, blue, depth = rows[i, RED], rows[i, GREEN], rows[i, BLUE], rows[i, DEPTH]
        first_row, last_row = row_range(rows, i, y, high, even)
        for row in range(first_row, last_row):
            low, most = column_range(rows, i, x, y, band, row, wide, even)
            _blend_row(state, row * EDGE + low, row * EDGE + most, x, y, xx, xy, yy, opacity, red, green, blue, depth)
    return end


@compiled(merged=True)
def row_range(rows: Singles, i: np.uint64, y: np.float32, high: int, even: bool) -> tuple[int, int]:
    """Return the range of rows of the tile that a splat at y may reach."""
    if not even:
        return 0, high
    half = rows[i, HALF_HEIGHT] + f32(PAD - 0.5)
    return int(max(y - half, f32(0))), int(min(y + half, f32(high - 1)) + f32(1))


@compiled(merged=True)
def column_range(
    rows: Singles, i: np.uint64, x: np.float32, y: np.float32, band: Singles, row: int, wide: int, even: bool
) -> tuple[int, int]:
    """Return the range of columns of a row that a splat at x, y may reach, in whole LANES."""
    if not even:
        half = rows[i, HALF_HEIGHT] + f32(PAD)
        return 0, EDGE if band[row, 1] > y - half and band[row, 0] < y + half else 0
    down = f32(row + 0.5) - y
    square = rows[i, REACH] * rows[i, XX] - down * down * rows[i, INVERSE_DET]
    if not square > f32(-1e-3):
        return 0, 0
    per = f32(1) / rows[i, XX]
    middle = x - rows[i, XY] * down * per - f32(0.5)
    half = sqrt(max(square, f32(0))) * per + f32(PAD)
    low, most = max(middle - half, f32(0)), min(middle + half, f32(wide - 1))
    if not low <= most:
        return 0, 0
    return int(low) // LANES * LANES, int(most) // LANES * LANES + LANES


@compiled(merged=True)
def _blend_row(
    state: Singles,
    begin: int,
    end: int,
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
    first = np.uint64(begin)
    for k in range(np.uint64(end - begin)):
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
    most = f32(0)
    for at in range(PIXELS):
        most = max(most, state[LIVE + np.uint64(at)])
    return most > 0
