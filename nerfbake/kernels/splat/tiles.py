"""Assign projected splats to the tiles of a picture."""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.splat.project import (
    HALF_HEIGHT,
    HALF_WIDTH,
    INVERSE_DET,
    REACH,
    X_REST,
    XX,
    XY,
    Y_REST,
    YY,
    X,
    Y,
)

EDGE = 16  # pixels along an edge of a tile
PAD = 0.05  # pixels: more than the rounding of a half-width in float32


class TileBoxes(NamedTuple):
    """Where the pixels of tiles lie, in pixels of a picture without lens distortion.

    rows, columns: numbers of tiles. even: the pixels form a grid; boxes and rows_of are empty then. boxes (tiles, 4),
    bands (rows, 4): least x, least y, largest x, largest y of the pixels' centres in a tile, and in a row of tiles.
    """

    rows: int
    columns: int
    even: bool
    boxes: Floats
    bands: Floats


def even_tiles(width: int, height: int) -> TileBoxes:
    """Return the tiles of a picture without lens distortion."""
    none = np.empty((0, 4))
    return TileBoxes(-(-height // EDGE), -(-width // EDGE), True, none, none)


def bent_tiles(places: Floats) -> TileBoxes:
    """Return the tiles of a picture whose pixels' centres lie at places (H, W, 2)."""
    across = np.arange(0, places.shape[1], EDGE)
    down = np.arange(0, places.shape[0], EDGE)
    low, high = (
        each.reduceat(each.reduceat(places, down, axis=0), across, axis=1) for each in (np.minimum, np.maximum)
    )
    bands = np.concatenate([low.min(axis=1), high.max(axis=1)], axis=1)
    return TileBoxes(len(down), len(across), False, np.concatenate([low, high], axis=2).reshape(-1, 4), bands)


@compiled()
def count_entries(rows: Singles, tiles: TileBoxes, counts: Ints) -> None:
    """Add to counts (tiles,) the number of splats that reach into each tile."""
    _visit(rows, tiles, 0, tiles.rows, counts, np.empty(0, np.int32), False)


@compiled()
def fill_entries(
    rows: Singles, tiles: TileBoxes, begin: int, end: int, ends: Ints, entries: npt.NDArray[np.int32]
) -> None:
    """Write the numbers of the splats of each tile in tile rows begin .. end, in the order of the splats.

    ends (tiles,): the place of each tile's first entry; afterwards, the place behind its last one.
    """
    _visit(rows, tiles, begin, end, ends, entries, True)


@compiled()
def _visit(
    rows: Singles, tiles: TileBoxes, begin: int, end: int, ends: Ints, entries: npt.NDArray[np.int32], fill: bool
) -> None:
    columns = tiles.columns
    for i in range(len(rows)):
        x, y = np.float64(rows[i, X]) + rows[i, X_REST], np.float64(rows[i, Y]) + rows[i, Y_REST]
        wide, high = rows[i, HALF_WIDTH] * (1 + 1e-6) + PAD, rows[i, HALF_HEIGHT] * (1 + 1e-6) + PAD
        if not tiles.even:
            for row in range(begin, end):
                if _apart(tiles.bands, row, x, y, wide, high):
                    continue
                for tile in range(row * columns, (row + 1) * columns):
                    if not _apart(tiles.boxes, tile, x, y, wide, high):
                        if fill:
                            entries[ends[tile]] = i
                        ends[tile] += 1
            continue
        top, bottom = tile_span(y - high, y + high, begin, end)
        left, right = tile_span(x - wide, x + wide, 0, columns)
        oblong = bottom - top > 1 and right - left > 1
        for row in range(top, bottom):
            if oblong:
                low, most = _width_between(rows, i, row * EDGE + 0.5 - y, row * EDGE + EDGE - 0.5 - y)
                left, right = tile_span(x + low - PAD, x + most + PAD, 0, columns)
            for tile in range(row * columns + left, row * columns + right):
                if fill:
                    entries[ends[tile]] = i
                ends[tile] += 1


@compiled(merged=True)
def tile_span(low: float, high: float, least: int, most: int) -> tuple[int, int]:
    """Return the range of tiles, within least .. most, that have a pixel centre in low .. high."""
    first = max((low - 0.5) / EDGE, np.float64(least))
    last = min((high - 0.5) / EDGE, np.float64(most))
    return int(first), min(int(last) + 1, most) if last >= first else int(first)


@compiled(merged=True)
def _apart(boxes: Floats, i: int, x: float, y: float, wide: float, high: float) -> bool:
    return bool(x + wide < boxes[i, 0] or x - wide > boxes[i, 2] or y + high < boxes[i, 1] or y - high > boxes[i, 3])


@compiled(merged=True)
def _width_between(rows: Singles, i: int, low: float, high: float) -> tuple[float, float]:
    """Return how far the ellipse of a splat reaches left and right where y is between low and high from its centre."""
    xx, xy, yy = np.float64(rows[i, XX]), np.float64(rows[i, XY]), np.float64(rows[i, YY])
    reach, per_det, wide = np.float64(rows[i, REACH]), np.float64(rows[i, INVERSE_DET]), np.float64(rows[i, HALF_WIDTH])
    at = xy / yy * wide  # y of the ellipse's leftmost point; its rightmost one is opposite
    leftmost, rightmost = min(max(at, low), high), min(max(-at, low), high)
    left = sqrt(max(reach * xx - leftmost * leftmost * per_det, 0.0))
    right = sqrt(max(reach * xx - rightmost * rightmost * per_det, 0.0))
    return (-xy * leftmost - left) / xx, (-xy * rightmost + right) / xx
