"""Plans for the next set of cells: which cells to keep and which to split, brick by brick.

A plan is a grid of bricks, and for each brick 512 codes, x-major, that name the source of each cell:

    -1                no cell
    row << 1 | wide   the values of this row; wide: one of the 2^3 places of a wide cell
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Ints
from nerfbake.kernels.fit.bricks import EMPTY, EMPTY_WIDE, SIZE, Top, top_grid
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

Codes = npt.NDArray[np.int32]
NONE = -1


class BrickPlan(NamedTuple):
    """top (S r, r, r): the numbers of the bricks, see kernels.fit.bricks.top_grid(); codes (b, 512)."""

    top: Top
    codes: Codes


class FinalBricks(NamedTuple):
    """The non-empty bricks of a plan: their tables for kernels.fit.bricks, and the source row of each cell."""

    top: Top
    slots: npt.NDArray[np.int16]
    first: npt.NDArray[np.int32]
    places: npt.NDArray[np.int16]
    row: npt.NDArray[np.int32]


def plan_of_solid(solid: Bits) -> BrickPlan:
    """Return the plan of the set cells of a grid (S R, R, R) bool, shell after shell; all of them copy row 0."""
    r = solid.shape[1] // 8
    bricks = solid.reshape(-1, 8, r, 8, r, 8).transpose(0, 2, 4, 1, 3, 5).reshape(-1, SIZE)
    held = bricks.any(axis=1)
    codes = np.where(bricks[held], np.int32(0), np.int32(NONE))
    return BrickPlan(top_grid(held.reshape(-1, r, r)), codes)


def plan_of_kept(top: Top, slots: npt.NDArray[np.int16], first: npt.NDArray[np.int32], keep: Bits) -> BrickPlan:
    """Return the plan of the cells that `keep` (n,) selects, unchanged."""
    codes = np.empty(slots.shape, np.int32)
    _kept(slots, first, keep, codes)
    return BrickPlan(top, codes)


def double_plan(plan: BrickPlan, split: Bits) -> BrickPlan:
    """Return the plan on a lattice twice as fine.

    Rows that `split` (n,) selects become eight cells, the others wide cells. The given plan must not contain wide
    cells.
    """
    held = np.repeat(np.repeat(np.repeat(plan.top >= 0, 2, 0), 2, 1), 2, 2)
    top = top_grid(held)
    places = np.argwhere(held)
    codes = np.empty((len(places), SIZE), np.int32)
    _doubled(plan, places, split, codes)
    return BrickPlan(top, codes)


def divide_plan(plan: BrickPlan, split: Bits) -> BrickPlan:
    """Return the plan on the same lattice, with the wide cells that `split` (n,) selects as eight cells."""
    codes = plan.codes
    chosen = (codes >= 0) & (codes & 1 == 1) & split[np.maximum(codes, 0) >> 1]
    return BrickPlan(plan.top, codes - chosen)


def number_cells(plan: BrickPlan) -> FinalBricks:
    """Number the cells, and remove bricks without cells."""
    held = (plan.codes >= 0).any(axis=1)
    solid = plan.top >= 0
    solid[solid] = held
    top, codes = top_grid(solid), plan.codes if held.all() else plan.codes[held]
    slots, counts = np.empty(codes.shape, np.int16), np.empty(len(codes), np.int64)
    _number(codes, slots, counts)
    first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    made, places = np.empty(int(first[-1]), np.int32), np.empty(int(first[-1]), np.int16)
    _collect(codes, slots, first, made, places)
    return FinalBricks(top, slots, first, places, made >> 1)


@on_every_core
@compiled()
def _kept(
    core: int, cores: int, slots: npt.NDArray[np.int16], first: npt.NDArray[np.int32], keep: Bits, codes: Codes
) -> None:
    for brick in range(core, len(slots), cores):
        for place in range(SIZE):
            slot = slots[brick, place]
            row = first[brick] + (slot >> 1)
            codes[brick, place] = row << 1 | slot & 1 if slot >= 0 and keep[row] else NONE


@on_every_core
@compiled()
def _doubled(core: int, cores: int, plan: BrickPlan, places: Ints, split: Bits, codes: Codes) -> None:
    for brick in range(core, len(places), cores):
        x, y, z = places[brick, 0], places[brick, 1], places[brick, 2]
        old = plan.top[x >> 1, y >> 1, z >> 1]
        for place in range(SIZE):
            i, j, k = 4 * (x & 1) + (place >> 7), 4 * (y & 1) + (place >> 4 & 3), 4 * (z & 1) + (place >> 1 & 3)
            code = plan.codes[old, i << 6 | j << 3 | k]
            codes[brick, place] = code | 1 if code >= 0 and not split[code >> 1] else code


@on_every_core
@compiled()
def _number(core: int, cores: int, codes: Codes, slots: npt.NDArray[np.int16], counts: Ints) -> None:
    for brick in range(core, len(codes), cores):
        cell = 0
        for place in range(SIZE):
            code, corner = codes[brick, place], place & ~0b001001001
            if code < 0:
                slot: Any = EMPTY
                alone = _all_empty(codes[brick], corner) if place == corner else slots[brick, corner] == EMPTY_WIDE
                if alone:
                    slot = EMPTY_WIDE
            elif code & 1 and place != corner:
                slot = np.int64(slots[brick, corner])
            else:
                slot = cell << 1 | code & 1
                cell += 1
            slots[brick, place] = slot
        counts[brick] = cell


@compiled()
def _all_empty(codes: Codes, corner: int) -> bool:
    held = 0
    for place in (0, 1, 8, 9, 64, 65, 72, 73):
        held += codes[corner + place] >= 0
    return held == 0


@on_every_core
@compiled()
def _collect(
    core: int,
    cores: int,
    codes: Codes,
    slots: npt.NDArray[np.int16],
    first: npt.NDArray[np.int32],
    made: npt.NDArray[np.int32],
    places: npt.NDArray[np.int16],
) -> None:
    for brick in range(core, len(codes), cores):
        cell = 0
        for place in range(SIZE):
            slot = slots[brick, place]
            if slot >= 0 and slot >> 1 == cell:
                made[first[brick] + cell] = codes[brick, place]
                places[first[brick] + cell] = place << 1 | slot & 1
                cell += 1
