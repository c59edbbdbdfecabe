"""The field during a fit: bricks of 8^3 cells, the grid of bricks, and the buffers of the tasks of one view.

Cells are numbered within their brick. The table of a brick takes 1 KB, and a task that hits a brick can store all its
sums for the brick in one run of rows. The values of a brick are contiguous, one coefficient of all its cells after the
other, so a CPU processes many cells at a time.

The grid of bricks contains the number of each brick. Where there is none, it contains the distance to the nearest one.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Ints, Singles
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

Top = npt.NDArray[np.int32]


def top_grid(held: Bits) -> Top:
    """Number the occupied places of a grid (S r, r, r) bool in raster order; return (S r, r, r) int32.

    The grid contains S shells, one after the other along x. An empty place contains -d, where d is the Chebyshev
    distance to the nearest brick of its shell, so a ray may skip d - 1 further bricks in every direction. In a shell
    without any brick, d is r everywhere.
    """
    r = held.shape[1]
    top = np.concatenate([_distances(shell) for shell in held.reshape(-1, r, r, r)])
    top[held] = np.arange(np.count_nonzero(held), dtype=np.int32)
    return top


def _distances(held: Bits) -> Top:
    """Return minus the distance (r, r, r) of each empty place to the nearest brick."""
    r = len(held)
    top = np.full(held.shape, -r, np.int32)
    near = held.copy()
    for away in range(1, r):
        wider = dilated(near)
        top[wider & ~near] = -away
        if wider.all() or not wider.any():
            break
        near = wider
    return top


Whole = Any  # an integer of any type
SIZE = 512  # places in a brick
# A slot is cell << 1 | wide; a wide cell fills a block of 2^3 places. EMPTY marks one empty place, EMPTY_WIDE each
# place of an empty block.
EMPTY, EMPTY_WIDE = -2, -1
# A task's row for a cell has 16 numbers: one cache line.
SIGMA = 3  # after red, green, blue: density per world unit
COLOUR_SUM, WEIGHT, DENSITY_SUM, CURVATURE, MOST, BLAME = 4, 7, 8, 9, 10, 11
ROW = 16
UNMET, LOST = -1, -2


class CornerGrid(NamedTuple):
    """The corners of cells with interpolated densities; all arrays are empty if densities are constant in each cell.

    of_cell     (n, 8) int16   the number of each corner 4 dx + 2 dy + dz of a cell in the list of its brick
    first       (b + 1,)       the first entry of each brick's list
    entries     (e,) int32     the corner of each entry
    back_first  (m + 1,)       the first of each corner's places in `back`
    back        (e,) int32     the entries of each corner
    raw         (m,)           raw densities, see kernels.fit.corners
    mean        (m,)           moving means of the curvature
    asked, curvature  (e,)     sums of a step, 0 between steps
    """

    of_cell: npt.NDArray[np.int16]
    first: npt.NDArray[np.int32]
    entries: npt.NDArray[np.int32]
    back_first: npt.NDArray[np.int32]
    back: npt.NDArray[np.int32]
    raw: Singles
    mean: Singles
    asked: Singles
    curvature: Singles


def no_corners() -> CornerGrid:
    """Return the corners of cells with constant densities."""
    ints, singles = np.zeros(0, np.int32), np.zeros(0, np.float32)
    return CornerGrid(np.zeros((0, 8), np.int16), ints, ints, ints, ints, *4 * (singles,))


class BrickGrid(NamedTuple):
    """The bricks of a field and their values.

    S concentric cubes have r^3 places for bricks each. Cube 0 is the inner one; cube k has cells 2^k times as wide, and
    bricks only outside of cube k - 1 (so it is a shell).

    top        (S r, r, r)      numbers of the bricks, see top_grid()
    slots      (b, 512) int16   the slot of each place in a brick, x-major
    first      (b + 1,)         the number of each brick's first cell
    places     (n,) int16       place << 1 | wide of each cell in its brick
    values     ((3 B + 1) n,)   of each brick in turn: the coefficients (all cells' first, all cells' second, ...),
                                then the densities, per width of the cell
    low, size  (S, 3)           each shell's corner and size of a cell, in the world
    width      (S,)             the width of each shell's cells that are not wide, in world units
    corners                     of the cells, if densities are interpolated
    """

    top: npt.NDArray[np.int32]
    slots: npt.NDArray[np.int16]
    first: npt.NDArray[np.int32]
    places: npt.NDArray[np.int16]
    values: Singles
    low: Floats
    size: Floats
    width: Floats
    corners: CornerGrid

    @property
    def smooth(self) -> bool:
        """True if densities are interpolated."""
        return len(self.corners.raw) > 0


class TaskBuffers(NamedTuple):
    """The results of the tasks for one view.

    base  (tasks, b)              the row of each brick's first cell in each task; UNMET, or LOST if there was no
                                  space left
    used  (tasks,)                rows that each task requested
    rows  (tasks, capacity, 16)   rows of the cells in the bricks that each task has hit. If densities are interpolated,
                                  DENSITY_SUM is not used, and further rows follow those of each brick's cells: see
                                  kernels.fit.corners.corner_rows()
    """

    base: npt.NDArray[np.int32]
    used: Ints
    rows: Singles


def new_batch(tasks: int, bricks: int, capacity: int) -> TaskBuffers:
    """Allocate the buffers. Their rows are aligned to cache lines."""
    flat = np.empty(tasks * capacity * ROW + ROW, np.float32)
    skip = -(flat.ctypes.data // 4) % ROW
    rows = flat[skip : skip + tasks * capacity * ROW].reshape(tasks, capacity, ROW)
    return TaskBuffers(np.empty((tasks, bricks), np.int32), np.zeros(tasks, np.int64), rows)


@on_every_core
@compiled()
def values_by_cell(core: int, cores: int, values: Singles, first: npt.NDArray[np.int32], out: Singles) -> None:
    """Convert the values of bricks into one row (n, 3 B + 1) for each cell."""
    for brick in range(core, len(first) - 1, cores):
        begin, end = np.int64(first[brick]), np.int64(first[brick + 1])
        D, count = out.shape[1], end - begin
        for cell in range(count):
            for k in range(D):
                out[begin + cell, k] = values[D * begin + k * count + cell]


@on_every_core
@compiled()
def values_by_brick(core: int, cores: int, values: Singles, first: npt.NDArray[np.int32], out: Singles) -> None:
    """Convert one row (n, 3 B + 1) for each cell into the values of bricks: the inverse of values_by_cell()."""
    for brick in range(core, len(first) - 1, cores):
        begin, end = np.int64(first[brick]), np.int64(first[brick + 1])
        D, count = values.shape[1], end - begin
        for cell in range(count):
            for k in range(D):
                out[D * begin + k * count + cell] = values[begin + cell, k]


@on_every_core
@compiled()
def copy_parents(core: int, cores: int, rows: npt.NDArray[np.int32], old: BrickGrid, new: BrickGrid) -> None:
    """Fill the values of the new bricks: cell i copies old cell `rows[i]` and keeps its density in the world.

    The new cells may have more coefficients than the old ones; these start at 0.
    """
    for brick in range(core, len(new.slots), cores):
        D, first = len(new.values) // len(rows), np.int64(new.first[brick])
        old_D = len(old.values) // np.int64(old.first[-1])
        B, old_B = (D - 1) // 3, (old_D - 1) // 3
        count, start = np.int64(new.first[brick + 1]) - first, D * first
        for cell in range(count):
            row = np.int64(rows[first + cell])
            held = np.searchsorted(old.first, row, side="right") - 1
            old_first, old_count = np.int64(old.first[held]), np.int64(old.first[held + 1] - old.first[held])
            at = old_D * old_first + row - old_first
            for channel in range(3):
                for k in range(B):
                    value = old.values[at + (channel * old_B + k) * old_count] if k < old_B else np.float32(0)
                    new.values[start + (channel * B + k) * count + cell] = value
            new.values[start + (D - 1) * count + cell] = old.values[at + (old_D - 1) * old_count]
            finer = len(old.top) * (1 + (new.places[first + cell] & 1)) / (len(new.top) * (1 + (old.places[row] & 1)))
            new.values[start + (D - 1) * count + cell] *= np.float32(finer)


@on_every_core
@compiled()
def round_cells(
    core: int, cores: int, values: Singles, first: npt.NDArray[np.int32], steps: Singles, density_step: float
) -> None:
    """Round the coefficients of each cell to multiples of its step (n,), and its density to one of density_step.

    All steps are powers of two.
    """
    for brick in range(core, len(first) - 1, cores):
        begin, end = np.int64(first[brick]), np.int64(first[brick + 1])
        D, count, one = len(values) // len(steps), end - begin, np.float32(1)
        for k in range(D):
            start = D * begin + k * count
            for cell in range(count):
                step = steps[begin + cell] if k < D - 1 else np.float32(density_step)
                values[start + cell] = np.rint(values[start + cell] * (one / step)) * step
