"""Brick fields: from given cells, random ones, and a Hypothesis strategy."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from nerfbake import BrickField
from nerfbake.kernels.fit.bricks import top_grid, values_by_brick
from nerfbake.kernels.fit.plan import double_plan, plan_of_kept
from nerfbake.scene.basis import Basis
from nerfbake.stages._bricks import BrickCells, cells_of_plan, cells_of_solid, field_of_cells


def brick_field_of(
    held: npt.NDArray[np.bool_], wide: npt.NDArray[np.bool_], values: npt.NDArray[np.float32], box: list[list[float]]
) -> BrickField:
    """Return a brick field with the given cells.

    held    (R, R, R) the cells that exist
    wide    (R/2, R/2, R/2) the blocks of 2^3 that are a single cell, whether or not `held` contains them
    values  (n, D) the rows of the cells in order; rows beyond the number of cells are not used
    """
    whole = wide.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    r = len(held) // 8
    bricks = (held | whole).reshape(r, 8, r, 8, r, 8).transpose(0, 2, 4, 1, 3, 5).reshape(r, r, r, 512)
    there: npt.NDArray[np.bool_] = np.any(bricks, axis=3)
    # A unique name per cell: its index in the lattice, or that of its block. Cells are then numbered in storage order.
    place = np.arange(held.size).reshape(held.shape)
    name = np.where(whole, place[::2, ::2, ::2].repeat(2, 0).repeat(2, 1).repeat(2, 2), place)
    names = name.reshape(r, 8, r, 8, r, 8).transpose(0, 2, 4, 1, 3, 5).reshape(r, r, r, 512)[there]
    is_wide = whole.reshape(r, 8, r, 8, r, 8).transpose(0, 2, 4, 1, 3, 5).reshape(r, r, r, 512)[there]
    rows = np.full(names.shape, -1, np.int32)
    cells = bricks[there]
    _, first, inverse = np.unique(names[cells], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    rows[cells] = rank[inverse] << 1 | is_wide[cells]
    basis = Basis("SH", (values.shape[1] - 1) // 3)
    return BrickField(len(held), np.array(box, np.float64), basis, top_grid(there), rows, values[: len(first)])


def some_brick_field(
    *, resolution: int = 32, basis: int = 4, seed: int = 0, share: float = 0.02, empty: bool = False
) -> BrickField:
    """A random brick field over a box with unequal edges. Some bricks exist, and half of the cells are wide.

    empty: some cells have no density.
    """
    random = np.random.default_rng(seed)
    R, r = resolution, resolution // 8
    bricks = (random.random((r, r, r)) < 0.4).repeat(8, 0).repeat(8, 1).repeat(8, 2)
    held = (random.random((R, R, R)) < share) & bricks
    wide = (random.random((R // 2,) * 3) < 0.5 * share) & bricks[::2, ::2, ::2]
    values = random.normal(0, 1, (R**3, 3 * basis + 1)).astype(np.float32)
    values[:, -1] = random.uniform(5, 60, R**3)
    if empty:
        values[random.random(R**3) < 0.3, -1] = 0
    return brick_field_of(held, wide, values, [[-1.0, -0.5, 0.25], [1.0, 1.0, 1.25]])


@st.composite
def brick_fields(draw: st.DrawFn) -> BrickField:
    """Random brick fields with no, one or several bricks."""
    return some_brick_field(
        resolution=draw(st.sampled_from([8, 16, 32])),
        basis=draw(st.sampled_from([1, 4, 9])),
        seed=draw(st.integers(0, 2**32)),
        share=draw(st.sampled_from([0.0, 0.01, 0.3])),
        empty=draw(st.booleans()),
    )


def lattice_points(field: BrickField) -> npt.NDArray[np.float64]:
    """(R^3, 3) world coordinates of the centres of all cells of the finest lattice, z fastest."""
    cells = np.indices((field.resolution,) * 3).reshape(3, -1).T
    return np.asarray(field.box[0] + (cells + 0.5) * field.cell_size, np.float64)


def sampled(field: BrickField) -> npt.NDArray[np.float32]:
    """(R^3, D) the values of each cell of the finest lattice; zeros where the density is 0."""
    values = field.sample(lattice_points(field))
    values[values[:, -1] == 0] = 0
    return values


BOX = np.array([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])


def some_shells(*, shells: int = 3, basis: int = 1, seed: int = 0, share: float = 0.02) -> BrickCells:
    """Random cells of 64^3 in an inner cube over BOX and in shells around it. About half of the cells are wide."""
    random = np.random.default_rng(seed)
    solid = random.random((shells, 32, 32, 32)) < share
    solid[1:, 8:24, 8:24, 8:24] = False
    coarse = cells_of_solid(solid.reshape(-1, 32, 32), BOX, basis)
    bricks = coarse.bricks
    plan = plan_of_kept(bricks.top, bricks.slots, bricks.first, np.ones(coarse.n, bool))
    cells = cells_of_plan(bricks, double_plan(plan, random.random(coarse.n) < 0.5), BOX, basis)
    values = random.normal(0, 1, (cells.n, 3 * basis + 1)).astype(np.float32)
    values[:, -1] = random.uniform(0.05, 0.5, cells.n)
    values_by_brick(values, cells.bricks.first, cells.bricks.values)
    return cells


def some_shelled_field(*, shells: int = 3, basis: int = 1, seed: int = 0) -> BrickField:
    """The field of some_shells()."""
    return field_of_cells(some_shells(shells=shells, basis=basis, seed=seed), BOX, Basis("SH", basis))
