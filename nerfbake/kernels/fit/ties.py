"""Pull the values of cells towards those of their neighbours: the more, the less the pictures say about a cell.

A value v moves to v + t / (t + e) (m - v): m is the mean of its neighbours, t the strength of the tie, and e what the
pictures say about it. Neighbours share a face and are in the same shell; where there is no cell, there is no neighbour.
A wide cell has one neighbour on each side, at its lowest corner.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.fit.bricks import SIZE, BrickGrid, Whole
from nerfbake.kernels.jit import borrowed, compiled, next_task
from nerfbake.kernels.parallel import on_every_core, taken_in_turn

_SIDES = 6
_BLOCK = 32  # places of bricks that a core processes before it takes the next block
_NOTHING = np.float32(1e-9)  # evidence of a cell that no ray has met, so that nothing is divided by 0
_Rows = npt.NDArray[np.int32]


class Ties(NamedTuple):
    """How strongly neighbours are tied: tie_coefficients() and tie_densities(). coefficients None: they are not."""

    coefficients: Singles | None
    density: float
    edge: float


def tie_coefficients(bricks: BrickGrid, means: Singles, strengths: Singles) -> None:
    """Pull the coefficients of all cells once, each towards what its neighbours were before.

    means (n, 2): as in take_steps(). Evidence is the moving mean of the cell's weight in a view, which is also the
    weight of a neighbour in the mean. strengths (B,): of each coefficient of a channel. Takes as much memory as the
    values.
    """
    _tie_coefficients(bricks, bricks.values.copy(), means, strengths)


def tie_densities(bricks: BrickGrid, means: Singles, strength: float, edge: float) -> None:
    """Pull the densities of all cells once, each towards what its neighbours were before.

    means (n, 2): as in take_steps(). Evidence is the moving mean of the curvature. edge: a difference of densities per
    lattice cell; a neighbour with this one counts half as much as one with none, and one with a much larger one hardly.
    Takes 4 bytes a cell. Raises ValueError for densities that are interpolated.
    """
    if bricks.smooth:
        raise ValueError("the densities are those of corners")
    before = np.empty(len(bricks.places), np.float32)
    _narrow_densities(bricks, before)
    _tie_densities(bricks, before, means, np.float32(strength), np.float32(edge))


@taken_in_turn
@compiled()
def _tie_coefficients(turn: Ints, bricks: BrickGrid, before: Singles, means: Singles, strengths: Singles) -> None:
    bricks, before, means, strengths = borrowed((bricks, before, means, strengths))
    places, B, rows = bricks.top.size, len(strengths), np.empty((_SIDES, SIZE), np.int32)
    at, step = np.empty((_SIDES, SIZE), np.int64), np.empty((_SIDES, SIZE), np.int64)
    weight, total = np.empty((_SIDES, SIZE), np.float32), np.empty(SIZE, np.float32)
    while True:
        block = next_task(turn)
        if block * _BLOCK >= places:
            break
        for place in range(block * _BLOCK, min((block + 1) * _BLOCK, places)):
            first, count = _find_neighbours(bricks, place, rows)
            _weigh_neighbours(bricks, means, B, count, rows, at, step, weight, total)
            for k in range(3 * B):
                start, strength = (3 * B + 1) * first + k * count, strengths[k % B]
                for cell in range(count):
                    if total[cell] > 0:
                        found = np.float32(0)
                        for side in range(_SIDES):
                            found += weight[side, cell] * before[at[side, cell] + k * step[side, cell]]
                        value, evidence = before[start + cell], means[first + cell, 1]
                        part = strength / (strength + evidence + _NOTHING)
                        bricks.values[start + cell] = value + part * (found / total[cell] - value)


@compiled()
def _weigh_neighbours(
    bricks: BrickGrid,
    means: Singles,
    B: int,
    count: int,
    rows: _Rows,
    at: Ints,
    step: Ints,
    weight: Singles,
    total: Singles,
) -> None:
    """Fill the weight of each neighbour, their total, and where its first coefficient and the next ones are."""
    for cell in range(count):
        total[cell] = np.float32(0)
        for side in range(_SIDES):
            here = rows[side, cell] >= 0
            row = np.int64(rows[side, cell]) if here else np.int64(0)
            weight[side, cell] = means[row, 1] if here else np.float32(0)
            total[cell] += weight[side, cell]
            brick = np.searchsorted(bricks.first, row, side="right") - 1
            begin = np.int64(bricks.first[brick])
            step[side, cell] = bricks.first[brick + 1] - begin
            at[side, cell] = (3 * B + 1) * begin + row - begin


@taken_in_turn
@compiled()
def _tie_densities(
    turn: Ints, bricks: BrickGrid, before: Singles, means: Singles, strength: np.float32, edge: np.float32
) -> None:
    bricks, before, means = borrowed((bricks, before, means))
    places, D, rows = bricks.top.size, len(bricks.values) // len(bricks.places), np.empty((_SIDES, SIZE), np.int32)
    while True:
        block = next_task(turn)
        if block * _BLOCK >= places:
            break
        for place in range(block * _BLOCK, min((block + 1) * _BLOCK, places)):
            first, count = _find_neighbours(bricks, place, rows)
            for cell in range(count):
                value, found, counted = before[first + cell], np.float32(0), np.float32(0)
                for side in range(_SIDES):
                    row = np.int64(rows[side, cell])
                    if row >= 0:
                        alike = edge / (edge + abs(before[row] - value))
                        found += alike * before[row]
                        counted += alike
                if counted > 0:
                    own = strength * min(counted, np.float32(1))
                    part = own / (own + means[first + cell, 0] + _NOTHING)
                    wide = np.float32(1 + (bricks.places[first + cell] & 1))
                    moved = value + part * (found / counted - value)
                    bricks.values[D * first + (D - 1) * count + cell] = moved * wide


@on_every_core
@compiled()
def _narrow_densities(core: int, cores: int, bricks: BrickGrid, out: Singles) -> None:
    """Fill the densities of all cells, (n,), per width of a cell that is not wide."""
    D = len(bricks.values) // len(bricks.places)
    for brick in range(core, len(bricks.slots), cores):
        first, count = np.int64(bricks.first[brick]), np.int64(bricks.first[brick + 1] - bricks.first[brick])
        for cell in range(count):
            wide = np.float32(1 + (bricks.places[first + cell] & 1))
            out[first + cell] = bricks.values[D * first + (D - 1) * count + cell] / wide


@compiled()
def _find_neighbours(bricks: BrickGrid, place: int, rows: _Rows) -> tuple[Whole, Whole]:
    """Fill the neighbours (6, 512) of the cells of the brick at a place: their numbers, or -1.

    Returns the first cell of the brick, and how many it has; 0 if there is no brick.
    """
    r = bricks.top.shape[1]
    shell, at0, at1, at2 = place // (r * r * r), place // (r * r) % r, place // r % r, place % r
    brick = np.int64(bricks.top[shell * r + at0, at1, at2])
    if brick < 0:
        return np.int64(0), np.int64(0)
    first, count = np.int64(bricks.first[brick]), np.int64(bricks.first[brick + 1] - bricks.first[brick])
    for cell in range(count):
        where = np.int64(bricks.places[first + cell])
        x, y, z = 8 * at0 + (where >> 7), 8 * at1 + (where >> 4 & 7), 8 * at2 + (where >> 1 & 7)
        for side in range(_SIDES):
            step = 1 + (where & 1) if side & 1 else -1
            a, b, c = x + step * (side >> 1 == 0), y + step * (side >> 1 == 1), z + step * (side >> 1 == 2)
            rows[side, cell] = -1
            if min(a, b, c) >= 0 and max(a, b, c) < 8 * r:
                other = np.int64(bricks.top[shell * r + a // 8, b // 8, c // 8])
                if other >= 0:
                    slot = np.int64(bricks.slots[other, (a % 8) << 6 | (b % 8) << 3 | c % 8])
                    if slot >= 0:
                        rows[side, cell] = bricks.first[other] + (slot >> 1)
    return first, count
