"""A field's cells while they are fitted: made of a solid, made anew by a plan, and as a BrickField."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.kernels.arrays import Bits, Points, Singles
from nerfbake.kernels.fit.bricks import Bricks, inherit, values_by_brick, values_by_cell
from nerfbake.kernels.fit.plan import NONE, Plan, Settled, plan_of_solid, settle
from nerfbake.kernels.maths.elementary import power
from nerfbake.scene.basis import Basis
from nerfbake.scene.brick_field import BrickField

START_DENSITY = 0.1  # per own width
_CELL_BYTES = 30  # of a cell, beside its values
_BRICK_BYTES = 8 * 512  # of a brick, while it is made


class Cells(NamedTuple):
    """bricks; means (n, 2): moving means of curvature and of weight; seen (n, 2): the largest weight, and the blame."""

    bricks: Bricks
    means: Singles
    seen: Singles

    @property
    def n(self) -> int:
        return len(self.means)


def cells_of_solid(solid: Bits, box: Points, B: int) -> Cells:
    """Grey and thin everywhere."""
    cells = _cells(settle(plan_of_solid(solid)), box, 3 * B + 1)
    values = np.zeros((cells.n, 3 * B + 1), np.float32)
    values[:, -1] = START_DENSITY
    values_by_brick(values, cells.bricks.first, cells.bricks.values)
    return cells


def cells_of_field(field: BrickField) -> Cells:
    """A field's own cells, as field_of_cells() gives them back."""
    codes = np.where(field.rows < 0, NONE, (field.rows >> 1) << 2 | field.rows & 1).astype(np.int32)
    # Both number cells as the bricks' tables first meet them.
    cells = _cells(settle(Plan(field.top, codes)), field.box, field.basis.data_dim, beside=field.values.nbytes)
    values = field.values.copy()
    values[:, -1] *= np.float32(cells.bricks.width) * (1 + field.wide).astype(np.float32)
    values_by_brick(values, cells.bricks.first, cells.bricks.values)
    return cells


def cells_of_plan(old: Bricks, plan: Plan, box: Points) -> Cells:
    """What a plan makes of the old bricks."""
    made = settle(plan)
    cells = _cells(made, box, len(old.values) // int(old.first[-1]), beside=4 * len(old.values))
    inherit(made.row, old, cells.bricks)
    return cells


def lattice(box: Points, resolution: int) -> tuple[Points, Points, float]:
    """The lattice's corner, the size of its cells, and the edge of a cube as large as one of them."""
    size = (box[1] - box[0]) / resolution
    return box[0].copy(), size, float(power(float(size[0] * size[1] * size[2]), 1 / 3))


def _cells(made: Settled, box: Points, D: int, *, beside: int = 0) -> Cells:
    """Whose values are still to be filled in. beside: bytes that are taken, and that nobody else counts."""
    n = len(made.row)
    memory.require(f"fitting {n:,} cells", n * (4 * D + _CELL_BYTES) + _BRICK_BYTES * len(made.slots) + beside)
    low, size, width = lattice(box, 8 * len(made.top))
    bricks = Bricks(made.top, made.slots, made.first, made.places, np.empty(D * n, np.float32), low, size, width)
    return Cells(bricks, np.zeros((n, 2), np.float32), np.zeros((n, 2), np.float32))


def field_of_cells(cells: Cells, box: Points, basis: Basis) -> BrickField:
    """The same field, with densities per world unit."""
    bricks = cells.bricks
    memory.require(f"a field of {cells.n:,} cells", 4 * len(bricks.values) + 4 * bricks.slots.size)
    values = np.empty((cells.n, basis.data_dim), np.float32)
    values_by_cell(bricks.values, bricks.first, values)
    values[:, -1] /= np.float32(bricks.width) * (1 + (bricks.places & 1)).astype(np.float32)
    shift = 2 * bricks.first[:-1, None]
    rows = np.where(bricks.slots >= 0, bricks.slots + shift, -1).astype(np.int32)
    return BrickField(8 * len(bricks.top), box.copy(), basis, bricks.top.copy(), rows, values)
