"""The way down to a cell, by table and by steps, in trees of every kind."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_array_equal

from nerfbake.kernels.jit import compiled
from nerfbake.kernels.march.cells import EMPTY, Cells, cells_of, descend, lowest, rows_at, with_rows


@compiled()
def at_every_place(cells: Cells, found: npt.NDArray[np.int64]) -> None:
    """(edge^3, 5): the slot, the width and the corner of each cell of the last level, x-major."""
    row = 0
    for x in range(cells.edge):
        for y in range(cells.edge):
            for z in range(cells.edge):
                slot, level = descend(cells, (x, y, z))
                found[row, 0], found[row, 1] = slot, cells.width[level]
                found[row, 2:] = lowest(cells, level, (x, y, z))
                row += 1


def tree(bits: list[int], *, radix: int = 0) -> Cells:
    """A third of the cells are empty, a third leaves, a third lead on; on the last level none does."""
    chance, nodes, leaves, levels = np.random.default_rng(len(bits)), 1, 0, []
    for level, width in enumerate(bits):
        kind = chance.integers(0, 2 if level == len(bits) - 1 else 3, (nodes, 1 << 3 * width))
        if radix:
            digits = np.stack(np.unravel_index(np.arange(1 << 3 * width), (1 << width,) * 3))
            kind[:, (digits >= radix).any(axis=0)] = 0
        slots = np.full(kind.shape, EMPTY, np.int32)
        slots[kind == 1] = -2 - leaves - np.arange((kind == 1).sum())
        slots[kind == 2] = np.arange((kind == 2).sum())
        leaves, nodes = leaves + int((kind == 1).sum()), int((kind == 2).sum())
        levels.append(slots.reshape(-1))
    first = np.cumsum([0, *(level.size for level in levels[:-1])]).tolist()
    return cells_of(np.concatenate(levels), bits, first=first, radix=radix)


@pytest.mark.parametrize(
    ("bits", "radix"),
    [([1], 0), ([1] * 5, 0), ([3, 2], 0), ([1, 1, 2, 1], 0), ([2] * 3, 3), ([5], 0), ([2, 2, 2], 0), ([3], 5)],
)
def test_every_cell_is_where_the_tree_has_it(bits: list[int], radix: int) -> None:
    cells = tree(bits, radix=radix)
    found = np.empty((cells.edge**3, 5), np.int64)
    at_every_place(cells, found)
    places = np.stack(np.unravel_index(np.arange(cells.edge**3), (cells.edge,) * 3), axis=1)
    rows = rows_at(cells, places.astype(np.float64) + 0.5)
    assert_array_equal(np.where(found[:, 0] == EMPTY, EMPTY, -2 - found[:, 0]), rows)
    assert len(set(rows.tolist())) > 3
    assert_array_equal(found[:, 2:], places // found[:, 1:2] * found[:, 1:2])


@pytest.mark.parametrize(("bits", "radix"), [([1] * 5, 0), ([3, 2], 0), ([2] * 3, 3)])
def test_leaves_are_found_by_their_new_rows_on_either_way_down(bits: list[int], radix: int) -> None:
    cells = tree(bits, radix=radix)
    new = np.arange(2 - cells.slots.min(), dtype=np.int32)[::-1].copy()
    new[::3] = EMPTY
    new[new != EMPTY] = -2 - new[new != EMPTY]
    before, after = (np.empty((cells.edge**3, 5), np.int64) for _ in range(2))
    at_every_place(cells, before)
    at_every_place(with_rows(cells, new), after)
    slots = before[:, 0]
    assert_array_equal(after[:, 0], np.where(slots < EMPTY, new[np.maximum(-2 - slots, 0)], slots))
    assert_array_equal(after[:, 1:], before[:, 1:])


def test_the_table_for_the_first_levels_stays_small() -> None:
    for bits in ([1] * 6, [2] * 3, [1, 4]):
        cells = tree(bits)
        assert len(cells.top) in (8, 64, 4096)
        assert len(cells.top) <= max(len(cells.slots) // 16, 1 << 3 * bits[0])
