"""Fields of bricks: any at all, and one of a given number of cells."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from hypothesis import strategies as st

from nerfbake import BrickField
from nerfbake.kernels.fit.topgrid import top_grid
from nerfbake.scene.basis import Basis


def brick_field_of(
    held: npt.NDArray[np.bool_], wide: npt.NDArray[np.bool_], values: npt.NDArray[np.float32], box: list[list[float]]
) -> BrickField:
    """held (R, R, R) the cells that are there; wide (R/2, R/2, R/2) the blocks of 2^3 that are one cell, whatever
    `held` says of them; values (n, D) from which each cell takes its row, as far as there are cells."""
    whole = wide.repeat(2, 0).repeat(2, 1).repeat(2, 2)
    r = len(held) // 8
    bricks = (held | whole).reshape(r, 8, r, 8, r, 8).transpose(0, 2, 4, 1, 3, 5).reshape(r, r, r, 512)
    there: npt.NDArray[np.bool_] = np.any(bricks, axis=3)
    # Each cell's own name: its place in the lattice, or that of its block; then numbered as they are met.
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
    """A lattice over an oblong box, of whose bricks some are there; half of its cells are wide. empty: some cells have
    no density."""
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
    """Any field of bricks, of none, one or several."""
    return some_brick_field(
        resolution=draw(st.sampled_from([8, 16, 32])),
        basis=draw(st.sampled_from([1, 4, 9])),
        seed=draw(st.integers(0, 2**32)),
        share=draw(st.sampled_from([0.0, 0.01, 0.3])),
        empty=draw(st.booleans()),
    )


def lattice_points(field: BrickField) -> npt.NDArray[np.float64]:
    """(R^3, 3) the centres of all cells of the finest lattice in the world, z fastest."""
    cells = np.indices((field.resolution,) * 3).reshape(3, -1).T
    return np.asarray(field.box[0] + (cells + 0.5) * field.cell_size, np.float64)


def sampled(field: BrickField) -> npt.NDArray[np.float32]:
    """(R^3, D) what each cell of the finest lattice holds; zeros where there is no density."""
    values = field.sample(lattice_points(field))
    values[values[:, -1] == 0] = 0
    return values
