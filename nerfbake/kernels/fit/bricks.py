"""The field while it is fitted: bricks of 8^3 cells with their values, and what one view's tasks make of them.

Cells are numbered within their brick, so that a brick's table is 1 KB, and a task that sees a brick can keep all that
it learns about it in one run of its own rows. A brick's values stand together, one coefficient of all its cells after
the other, so that a processor takes many cells at a time.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.jit import compiled

Whole = Any  # a whole number, of any type
SIZE = 512  # cells of a brick
# A slot is cell << 1 | wide; or nothing, in one cell or in all eight of a wide one.
EMPTY, EMPTY_WIDE = -2, -1
# A row of what a task makes of a cell: 16 numbers, a line of the cache.
SIGMA = 3  # behind red, green, blue: density per world unit
COLOUR_SUM, WEIGHT, DENSITY_SUM, CURVATURE, MOST, BLAME = 4, 7, 8, 9, 10, 11
ROW = 16
UNMET, LOST = -1, -2


class Bricks(NamedTuple):
    """top (r, r, r): kernels.fit.topgrid. slots (b, 512) int16, x-major. first (b + 1,): the number of each brick's
    first cell. places (n,) int16: place << 1 | wide of each cell in its brick.

    values ((3 B + 1) n,): of each brick in turn the coefficients, all cells' first, all cells' second, ...; then the
    densities, per own width. low, size (3,): the lattice's corner and its cells in the world; width: what "own width"
    is of a cell that is not wide.
    """

    top: npt.NDArray[np.int32]
    slots: npt.NDArray[np.int16]
    first: npt.NDArray[np.int32]
    places: npt.NDArray[np.int16]
    values: Singles
    low: Floats
    size: Floats
    width: float


class Batch(NamedTuple):
    """What tasks make of one view: rows (tasks, capacity, 16) of the cells in the bricks that each has met, whose first
    row in it is base (tasks, b): UNMET, or LOST where the rows were too few. used (tasks,): rows asked for.
    """

    base: npt.NDArray[np.int32]
    used: Ints
    rows: Singles


def new_batch(tasks: int, bricks: int, capacity: int) -> Batch:
    """Its rows start where a line of the cache does."""
    flat = np.empty(tasks * capacity * ROW + ROW, np.float32)
    skip = -(flat.ctypes.data // 4) % ROW
    rows = flat[skip : skip + tasks * capacity * ROW].reshape(tasks, capacity, ROW)
    return Batch(np.empty((tasks, bricks), np.int32), np.zeros(tasks, np.int64), rows)


# Loops in parallel only call what does the work: with more in them, numba was seen to mix up the turns' variables.
@compiled(parallel=True)
def values_by_cell(values: Singles, first: npt.NDArray[np.int32], out: Singles) -> None:
    """A brick's values as a row (n, 3 B + 1) for each cell."""
    for brick in prange(len(first) - 1):
        _by_cell(values, np.int64(first[brick]), np.int64(first[brick + 1]), out)


@compiled()
def _by_cell(values: Singles, begin: Whole, end: Whole, out: Singles) -> None:
    D, count = out.shape[1], end - begin
    for cell in range(count):
        for k in range(D):
            out[begin + cell, k] = values[D * begin + k * count + cell]


@compiled(parallel=True)
def values_by_brick(values: Singles, first: npt.NDArray[np.int32], out: Singles) -> None:
    """A row (n, 3 B + 1) for each cell as bricks' values, the way back."""
    for brick in prange(len(first) - 1):
        _by_brick(values, np.int64(first[brick]), np.int64(first[brick + 1]), out)


@compiled()
def _by_brick(values: Singles, begin: Whole, end: Whole, out: Singles) -> None:
    D, count = values.shape[1], end - begin
    for cell in range(count):
        for k in range(D):
            out[D * begin + k * count + cell] = values[begin + cell, k]


@compiled(parallel=True)
def inherit(rows: npt.NDArray[np.int32], old: Bricks, new: Bricks) -> None:
    """Fills in the new bricks' values: cell i is what cell `rows[i]` of the old ones was, as dense in the world."""
    for brick in prange(len(new.slots)):
        _inherit(rows, old, new, brick)


@compiled()
def _inherit(rows: npt.NDArray[np.int32], old: Bricks, new: Bricks, brick: int) -> None:
    D, first = len(new.values) // len(rows), np.int64(new.first[brick])
    count, start = np.int64(new.first[brick + 1]) - first, D * first
    for cell in range(count):
        row = np.int64(rows[first + cell])
        held = np.searchsorted(old.first, row, side="right") - 1
        old_first, old_count = np.int64(old.first[held]), np.int64(old.first[held + 1] - old.first[held])
        for k in range(D):
            new.values[start + k * count + cell] = old.values[D * old_first + k * old_count + row - old_first]
        finer = len(old.top) * (1 + (new.places[first + cell] & 1)) / (len(new.top) * (1 + (old.places[row] & 1)))
        new.values[start + (D - 1) * count + cell] *= np.float32(finer)
