"""The cells of a field during a fit: create them from a solid, a field or a plan, and convert them to a BrickField."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.kernels.arrays import Bits, Coords, Floats, Ints, Points, Singles
from nerfbake.kernels.fit.bricks import BrickGrid, copy_parents, no_corners, values_by_brick, values_by_cell
from nerfbake.kernels.fit.corners import fill_densities, find_corners, raw_of_density, refine_corners
from nerfbake.kernels.fit.plan import NONE, BrickPlan, FinalBricks, number_cells, plan_of_solid
from nerfbake.kernels.maths.elementary import power
from nerfbake.scene.basis import Basis
from nerfbake.scene.brick_field import BrickField

START_DENSITY = 0.1  # per cell width, in the visual hull of an object
_CELL_BYTES = 30  # per cell, in addition to its values
_BRICK_BYTES = 8 * 512  # per brick, while its tables are computed
_CORNER_BYTES = 100  # of the corners of a cell, while they are found


class BrickCells(NamedTuple):
    """The cells of a field, and the statistics of its fit.

    bricks  the tables and values; densities are per cell width
    means   (n, 2): moving means of the curvature and of the weight
    seen    (n, 2): the largest weight, and the blame (the sum of weight times pixel error)
    """

    bricks: BrickGrid
    means: Singles
    seen: Singles

    @property
    def n(self) -> int:
        return len(self.means)

    @property
    def B(self) -> int:
        """Number of coefficients of a channel."""
        return (len(self.bricks.values) // self.n - 1) // 3


def cells_of_solid(
    solid: Bits, box: Points, B: int, density: float = START_DENSITY, *, smooth: bool = False
) -> BrickCells:
    """Return grey cells of low density, per cell width, for all cells of a solid (S R, R, R), shell after shell.

    smooth: densities are interpolated between the corners of cells.
    """
    cells = _cells(number_cells(plan_of_solid(solid)), box, 3 * B + 1)
    values = np.zeros((cells.n, 3 * B + 1), np.float32)
    values[:, -1] = density
    values_by_brick(values, cells.bricks.first, cells.bricks.values)
    if smooth:
        cells = with_corners(cells)
        cells.bricks.corners.raw[:] = raw_of_density(density)
    return cells


def with_corners(cells: BrickCells) -> BrickCells:
    """Return the cells with corners between which their densities are interpolated; all are almost transparent."""
    memory.require(f"the corners of {cells.n:,} cells", _CORNER_BYTES * cells.n)
    bricks = cells.bricks
    return cells._replace(bricks=bricks._replace(corners=find_corners(bricks.top, bricks.first, bricks.places)))


def cells_of_field(field: BrickField) -> BrickCells:
    """Return the cells of a field. field_of_cells() is the inverse."""
    codes = np.where(field.rows < 0, NONE, (field.rows >> 1) << 2 | field.rows & 1).astype(np.int32)
    # The plan and the field both number the cells in order of first occurrence in the bricks' tables.
    cells = _cells(
        number_cells(BrickPlan(field.top, codes)), field.box, field.basis.data_dim, beside=field.values.nbytes
    )
    values = field.values.copy()
    values[:, -1] *= _widths(cells.bricks)
    values_by_brick(values, cells.bricks.first, cells.bricks.values)
    return cells


def cells_of_plan(old: BrickGrid, plan: BrickPlan, box: Points, B: int, *, smooth: bool = False) -> BrickCells:
    """Return the cells of a plan, with values inherited from the old bricks.

    B: number of coefficients of a channel, as many as in the old bricks or more. smooth: densities are interpolated
    between the corners of cells, as in the old bricks. Otherwise, the density of a cell whose density was interpolated
    is its mean.
    """
    made = number_cells(plan)
    del plan  # frees its memory before the values are copied, if the caller does not keep it
    cells = _cells(made, box, 3 * B + 1, beside=4 * len(old.values))
    copy_parents(made.row, old, cells.bricks)
    if smooth:
        cells = with_corners(cells)
        refine_corners(made.row, old, cells.bricks)
    elif old.smooth:
        fill_densities(made.row, old, cells.bricks)
    return cells


def lattice_frame(box: Points, resolution: int, shells: int) -> tuple[Points, Points, Floats]:
    """Return each shell's lowest corner and edges of a cell (S, 3), and the edges (S,) of cubes with a cell's volume.

    box: the innermost one.
    """
    size = (box[1] - box[0]) / resolution
    scale = (1 << np.arange(shells)).astype(np.float64)[:, None]
    width = float(power(float(size[0] * size[1] * size[2]), 1 / 3))
    return box[0] - (scale - 1) * (resolution / 2 * size), size * scale, width * scale[:, 0]


def _widths(bricks: BrickGrid) -> Singles:
    """Return the width (n,) of each cell in world units."""
    shell = np.argwhere(bricks.top >= 0)[:, 0] // bricks.top.shape[1]
    width = np.repeat(bricks.width[shell].astype(np.float32), np.diff(bricks.first))
    return np.asarray(width * (1 + (bricks.places & 1)), np.float32)


def _cells(made: FinalBricks, box: Points, D: int, *, beside: int = 0) -> BrickCells:
    """Return cells with uninitialised values. `beside` is the number of bytes in use that are not counted elsewhere."""
    n = len(made.row)
    memory.require(f"fitting {n:,} cells", n * (4 * D + _CELL_BYTES) + _BRICK_BYTES * len(made.slots) + beside)
    r = made.top.shape[1]
    low, size, width = lattice_frame(box, 8 * r, len(made.top) // r)
    values = np.empty(D * n, np.float32)
    bricks = BrickGrid(made.top, made.slots, made.first, made.places, values, low, size, width, no_corners())
    return BrickCells(bricks, np.zeros((n, 2), np.float32), np.zeros((n, 2), np.float32))


def field_of_cells(cells: BrickCells, box: Points, basis: Basis) -> BrickField:
    """Return the cells as a BrickField, with densities per world unit."""
    bricks = cells.bricks
    memory.require(f"a field of {cells.n:,} cells", 4 * len(bricks.values) + 4 * bricks.slots.size)
    if bricks.smooth:
        bricks = bricks._replace(values=bricks.values.copy())
        fill_densities(np.arange(cells.n, dtype=np.int32), bricks, bricks)
    values = np.empty((cells.n, basis.data_dim), np.float32)
    values_by_cell(bricks.values, bricks.first, values)
    values[:, -1] /= _widths(bricks)
    rows = bricks.slots.astype(np.int32)  # changed in place: with small cells, this table is large
    rows += 2 * bricks.first[:-1, None]
    rows[bricks.slots < 0] = -1
    return BrickField(8 * bricks.top.shape[1], box.copy(), basis, bricks.top.copy(), rows, values)


def cell_places(bricks: BrickGrid) -> tuple[Ints, Coords]:
    """Return each cell's shell (n,), and its lowest lattice cell (n, 3) in the grid of that shell."""
    r = bricks.top.shape[1]
    brick = np.repeat(np.argwhere(bricks.top >= 0), np.diff(bricks.first), axis=0)
    place = bricks.places >> 1
    within = np.stack([place >> 6, place >> 3 & 7, place & 7], axis=1)
    return brick[:, 0] // r, (8 * (brick % r) + within).astype(np.int32)
