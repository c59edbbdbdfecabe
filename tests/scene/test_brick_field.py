from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import BrickField
from nerfbake.errors import InvalidScene
from nerfbake.kernels.fit.bricks import top_grid
from nerfbake.scene.basis import Basis


def field(**fields: Any) -> BrickField:
    """A lattice of 16^3 over a box of 16 x 32 x 16 with one brick, the last: one cell, and one wide cell behind it."""
    held = np.zeros((2, 2, 2), bool)
    held[1, 1, 1] = True
    cells = np.full((8, 8, 8), -1, np.int32)
    cells[0, 0, 1] = 0
    cells[2:4, 4:6, 6:8] = 1 << 1 | 1
    values = np.array([[1, 2, 3, 5], [4, 5, 6, 7]], np.float32)
    made: dict[str, Any] = {"resolution": 16, "box": np.array([[0.0, 0, 0], [16, 32, 16]]), "basis": Basis("SH", 1)}
    made |= {"top": top_grid(held), "rows": cells.reshape(1, 512), "values": values}
    return BrickField(**(made | fields))


def test_cells_stand_where_their_brick_does() -> None:
    made = field()
    made.require_usable()
    assert_array_equal(made.cell_size, [1, 2, 1])
    assert_array_equal(made.corners, [[8, 8, 9], [10, 12, 14]])
    assert_array_equal(made.wide, [False, True])
    points = np.array(
        [[8.5, 16.5, 9.5], [8.5, 16.5, 8.5], [11.9, 27.9, 15.9], [10.1, 24.1, 14.1], [0, 0, 0], [16, 0, 0]]
    )
    assert_array_equal(made.rows_at(points), [0, -1, 1, 1, -1, -1])
    assert_array_equal(made.sample(points)[:, 3], [5, 0, 7, 7, 0, 0])


def wrong_rows(**cells: int) -> Any:
    rows = field().rows.copy()
    for name, value in cells.items():
        rows[0, int(name[1:])] = value
    return rows


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"resolution": 24}, "resolution is 24; allowed: a power of two, 8 to 4096"),
        ({"basis": Basis("RGBA", 1)}, "basis is RGBA; allowed: SH1, SH4"),
        ({"top": np.zeros((1, 2, 2), np.int32)}, r"the field's top has shape \(1, 2, 2\)"),
        ({"rows": np.zeros((1, 64), np.int32)}, r"the field's rows has shape \(1, 64\)"),
        ({"values": np.zeros((2, 4))}, "the field's values has shape .* float64"),
        ({"box": np.zeros((2, 3))}, "box's edges"),
        ({"box": np.array([[0, 0, 0], [1, 1, np.nan]])}, r"box\[1, 2\] is nan"),
        ({"top": np.full((2, 2, 2), -1, np.int32)}, "top numbers 0 bricks; allowed: 1"),
        ({"top": top_grid(np.arange(8).reshape(2, 2, 2) == 7) - (np.arange(8).reshape(2, 2, 2) == 0)}, "raster order"),
        ({"rows": wrong_rows(c0=4)}, r"rows\[0, 0\] is 4; allowed: -1 to 3"),
        ({"rows": wrong_rows(c0=2)}, "rows are not numbered in order"),
        ({"rows": wrong_rows(c1=-1)}, "rows are not numbered in order"),
        ({"rows": wrong_rows(c166=-1)}, "an incomplete wide cell"),
        ({"rows": wrong_rows(c9=0)}, "contain a cell twice"),
        ({"values": np.array([[0, 0, 0, 1], [0, 0, np.inf, 1]], np.float32)}, r"values\[1, 2\] is inf"),
        ({"values": np.array([[0, 0, 0, 1], [0, 0, 0, -1]], np.float32)}, "a density of 0 or more"),
    ],
)
def test_what_cannot_be_a_field_is_refused(wrong: dict[str, Any], message: str) -> None:
    with pytest.raises(InvalidScene, match=message):
        field(**wrong).require_usable()
