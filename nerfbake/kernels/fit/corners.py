"""Densities that are interpolated between the corners of cells, in the first stages of a fit.

A corner has a raw density x, which is interpolated in each cell along all axes. The density per width of a cell is then
x where x is above 1, and e^(x - 1) elsewhere, so a surface may lie anywhere in a cell. Each ray takes the density in
the middle of its way through a cell.

The corners of a brick's cells are a list of their own, so that bricks can add up their steps independently: an entry of
a list is one corner of one brick. Cells of two widths have no common corners, so no cell is wide here.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Coords, Floats, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.fit.bricks import (
    ROW,
    BrickGrid,
    CornerGrid,
    TaskBuffers,
    Top,
    Whole,
)
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.kernels.parallel import on_every_core

LEAST_RAW, MOST_RAW = -4.0, 12.0  # densities of 0.007 and 12 per cell width
_GRID = 729  # corners of a brick with all its cells


@compiled(merged=True)
def density_of_raw(raw: float) -> tuple[float, float]:
    """Return the density per cell width, and its slope."""
    whole, rest = compiled_exp_parts(min(raw, 1.0) - 1.0)
    low = whole + whole * rest
    return (raw, 1.0) if raw > 1 else (low, low)


def raw_of_density(density: npt.ArrayLike) -> Singles:
    """Return the raw densities of densities per cell width, at least LEAST_RAW."""
    density = np.asarray(density, np.float64)
    low = np.maximum(log(np.maximum(density, 1e-9)) + 1, LEAST_RAW)
    return np.asarray(np.where(density > 1, density, low), np.float32)


def find_corners(top: Top, first: npt.NDArray[np.int32], places: npt.NDArray[np.int16]) -> CornerGrid:
    """Return the corners of the cells of bricks. Their raw densities are the least."""
    bricks, r = np.argwhere(top >= 0).astype(np.int32), top.shape[1]
    of_cell, counts = np.empty((len(places), 8), np.int16), np.empty(len(bricks), np.int64)
    _number_in_bricks(first, places, of_cell, counts)
    starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    keys = np.empty(int(starts[-1]), np.int64)
    _place_entries(bricks, r, first, places, of_cell, starts, keys)
    back = np.argsort(keys, kind="stable").astype(np.int32)
    begins = np.diff(keys[back], prepend=-1) > 0  # where the entries of another corner begin
    e, entries = len(keys), np.empty(len(keys), np.int32)
    entries[back] = np.cumsum(begins) - 1
    back_first = np.append(np.flatnonzero(begins), e).astype(np.int32)
    m = len(back_first) - 1
    raw, mean = np.full(m, LEAST_RAW, np.float32), np.zeros(m, np.float32)
    asked, curvature = np.zeros(e, np.float32), np.zeros(e, np.float32)
    return CornerGrid(of_cell, starts, entries, back_first, back, raw, mean, asked, curvature)


@compiled(merged=True)
def _corner_of_place(place: Whole, corner: Whole) -> Any:
    """Return the corner 4 dx + 2 dy + dz of a cell in the 9^3 corners of its brick, x-major."""
    x, y, z = (place >> 7) + (corner >> 2), (place >> 4 & 7) + (corner >> 1 & 1), (place >> 1 & 7) + (corner & 1)
    return x * 81 + y * 9 + z


@on_every_core
@compiled()
def _number_in_bricks(
    core: int,
    cores: int,
    first: npt.NDArray[np.int32],
    places: npt.NDArray[np.int16],
    of_cell: npt.NDArray[np.int16],
    counts: npt.NDArray[np.int64],
) -> None:
    numbers = np.empty(_GRID, np.int16)
    for brick in range(core, len(counts), cores):
        numbers[:] = -1
        count = 0
        for cell in range(first[brick], first[brick + 1]):
            for corner in range(8):
                at = _corner_of_place(np.int64(places[cell]), corner)
                if numbers[at] < 0:
                    numbers[at] = count
                    count += 1
                of_cell[cell, corner] = numbers[at]
        counts[brick] = count


@on_every_core
@compiled()
def _place_entries(
    core: int,
    cores: int,
    bricks: Coords,
    r: int,
    first: npt.NDArray[np.int32],
    places: npt.NDArray[np.int16],
    of_cell: npt.NDArray[np.int16],
    starts: npt.NDArray[np.int32],
    keys: npt.NDArray[np.int64],
) -> None:
    """Write the place of each entry in the lattice of all corners; each shell has its own."""
    edge = np.int64(8 * r + 1)
    for brick in range(core, len(bricks), cores):
        x = 8 * np.int64(bricks[brick, 0]) + np.int64(bricks[brick, 0]) // r
        y, z = 8 * np.int64(bricks[brick, 1]), 8 * np.int64(bricks[brick, 2])
        for cell in range(first[brick], first[brick + 1]):
            for corner in range(8):
                at = _corner_of_place(np.int64(places[cell]), corner)
                key = ((x + at // 81) * edge + y + at // 9 % 9) * edge + z + at % 9
                keys[starts[brick] + of_cell[cell, corner]] = key


def refine_corners(rows: npt.NDArray[np.int32], old: BrickGrid, new: BrickGrid) -> None:
    """Fill the raw densities of new cells, of which cell i is old cell `rows[i]` or one of its eight parts.

    The density in the world is kept at each corner.
    """
    finer = len(new.top) // len(old.top)
    _interpolate(rows, finer, old, new)
    if finer > 1:
        raw = new.corners.raw.astype(np.float64)
        density = np.where(raw > 1, raw, exp(np.minimum(raw, 1) - 1)) / finer
        new.corners.raw[:] = raw_of_density(density)


@on_every_core
@compiled()
def _interpolate(
    core: int, cores: int, rows: npt.NDArray[np.int32], finer: int, old: BrickGrid, new: BrickGrid
) -> None:
    # Several cells write to a corner. They have the same corners of old cells, so they write the same bits.
    raw = np.empty(8)
    for brick in range(core, len(new.slots), cores):
        for cell in range(new.first[brick], new.first[brick + 1]):
            place = np.int64(new.places[cell])
            _read_corners(old, np.int64(rows[cell]), raw)
            for corner in range(8):
                x, y, z = np.float64(corner >> 2), np.float64(corner >> 1 & 1), np.float64(corner & 1)
                if finer > 1:
                    x, y, z = ((place >> 7 & 1) + x) / 2, ((place >> 4 & 1) + y) / 2, ((place >> 1 & 1) + z) / 2
                new.corners.raw[_corner(new, brick, cell, corner)] = between(raw, x, y, z)


@compiled(merged=True)
def _read_corners(bricks: BrickGrid, cell: Whole, raw: Floats) -> None:
    """Read the raw densities of a cell's corners."""
    brick = np.searchsorted(bricks.first, cell, side="right") - 1
    for corner in range(8):
        raw[corner] = bricks.corners.raw[_corner(bricks, brick, cell, corner)]


@compiled(merged=True)
def _corner(bricks: BrickGrid, brick: Whole, cell: Whole, corner: Whole) -> Any:
    """Return the number of a cell's corner."""
    return bricks.corners.entries[np.int64(bricks.corners.first[brick]) + bricks.corners.of_cell[cell, corner]]


@compiled(merged=True)
def between(raw: Any, x: float, y: float, z: float) -> Any:
    """Interpolate eight values, of the corners 4 dx + 2 dy + dz, at a place from 0 to 1 along each axis."""
    a, b = raw[0] * (1 - z) + raw[1] * z, raw[2] * (1 - z) + raw[3] * z
    c, d = raw[4] * (1 - z) + raw[5] * z, raw[6] * (1 - z) + raw[7] * z
    return (a * (1 - y) + b * y) * (1 - x) + (c * (1 - y) + d * y) * x


@on_every_core
@compiled()
def fill_densities(core: int, cores: int, rows: npt.NDArray[np.int32], old: BrickGrid, new: BrickGrid) -> None:
    """Set the densities of new cells, of which cell i is old cell `rows[i]` or a part of it.

    The density of a cell is the mean over the centres of its eight parts.
    """
    raw, finer = np.empty(8), len(new.top) // len(old.top)
    for brick in range(core, len(new.slots), cores):
        first, count = np.int64(new.first[brick]), np.int64(new.first[brick + 1] - new.first[brick])
        D = len(new.values) // np.int64(new.first[-1])
        for cell in range(count):
            place = np.int64(new.places[first + cell])
            _read_corners(old, np.int64(rows[first + cell]), raw)
            # The new cell's corner and width, in the old cell.
            x, y, z = (
                (place >> 7 & finer - 1) / finer,
                (place >> 4 & finer - 1) / finer,
                (place >> 1 & finer - 1) / finer,
            )
            width, total = (1 + (place & 1)) / finer, 0.0
            for part in range(8):
                i, j, k = 0.25 + 0.5 * (part >> 2), 0.25 + 0.5 * (part >> 1 & 1), 0.25 + 0.5 * (part & 1)
                total += density_of_raw(between(raw, x + width * i, y + width * j, z + width * k))[0]
            new.values[D * first + (D - 1) * count + cell] = total / 8 * width


@compiled(merged=True)
def corner_rows(bricks: BrickGrid, brick: Whole) -> Any:
    """Return the number of rows for the raw densities of a brick's corners; as many follow, for their sums.

    Corner k of the brick's list has number k % 16 in row k // 16.
    """
    return (np.int64(bricks.corners.first[brick + 1] - bricks.corners.first[brick]) + ROW - 1) // ROW


@compiled()
def fill_corner_rows(bricks: BrickGrid, batch: TaskBuffers, task: Whole, brick: Whole, base: Whole) -> None:
    """Fill the rows from `base` on with the raw densities of a brick's corners, and those after them with zeros."""
    start = np.int64(bricks.corners.first[brick])
    count = np.int64(bricks.corners.first[brick + 1]) - start
    sums = base + corner_rows(bricks, brick)
    for k in range(count):
        batch.rows[task, base + (k >> 4), k & 15] = bricks.corners.raw[bricks.corners.entries[start + k]]
        batch.rows[task, sums + (k >> 4), k & 15] = 0
