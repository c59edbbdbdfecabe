"""What a task needs to know of a brick that it meets: the colours of its cells as they look from the camera."""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import numpy as np

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.fit.bricks import LOST, ROW, SIGMA, SIZE, Batch, Bricks, Whole
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.march.sh import fill_basis

compiled_fill_basis: Any = compiled()(fill_basis)
_K0, _K1, _K2, _K20 = 0.5 / sqrt(pi), sqrt(3 / (4 * pi)), sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
_X, _Y, _Z, _SUM, _BASIS = 0, 1, 2, 3, 4  # rows of the room to work in


@compiled()
def new_room(B: int) -> Singles:
    """(4 + B, 512): room for directions, a sum, and the basis of a brick's cells."""
    return np.empty((_BASIS + B, SIZE), np.float32)


@compiled()
def enter(bricks: Bricks, batch: Batch, task: Whole, brick: Whole, at: Any, eye: Floats, room: Singles) -> Whole:
    """Fills the rows of a brick's cells and gives the first one's number; LOST where there is no room left.

    at (3,) int: the brick in the top grid; eye (3,) in the world.
    """
    first, count = np.int64(bricks.first[brick]), np.int64(bricks.first[brick + 1] - bricks.first[brick])
    base = batch.used[task]
    batch.used[task] = base + count
    if base + count > batch.rows.shape[1]:
        batch.base[task, brick] = LOST
        return np.int64(LOST)
    batch.base[task, brick] = base
    B, low, size = len(room) - _BASIS, bricks.low, bricks.size
    x = np.float32(low[0] + 8 * at[0] * size[0] - eye[0])
    y = np.float32(low[1] + 8 * at[1] * size[1] - eye[1])
    z = np.float32(low[2] + 8 * at[2] * size[2] - eye[2])
    look(bricks.places, first, count, x, y, z, np.float32(size[0]), np.float32(size[1]), np.float32(size[2]), room)
    start = (3 * B + 1) * first
    for channel in range(3):
        _colour(bricks.values, start + channel * B * count, count, B, room, batch.rows, task, base, channel)
    _fill(bricks.values, start + 3 * B * count, bricks.places, first, count, bricks.width, batch.rows, task, base)
    return np.int64(base)


# Indices below are unsigned: a signed one may be negative, which costs a comparison and the vector instructions.
@compiled()
def look(
    places: Any, first: Whole, count: Whole, x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any, room: Singles
) -> None:
    """The basis in the directions to the centres of a brick's cells; x, y, z: to the brick's corner; dx, dy, dz: the
    size of a cell, all float32.
    """
    start, half = np.uint64(first), np.float32(0.5)
    for cell in range(np.uint64(count)):
        place = np.int32(places[start + cell])
        middle = np.float32((place & 1) + 1) * half
        a = x + (np.float32(place >> 7) + middle) * dx
        b = y + (np.float32(place >> 4 & 7) + middle) * dy
        c = z + (np.float32(place >> 1 & 7) + middle) * dz
        part = np.float32(1) / np.sqrt(a * a + b * b + c * c + np.float32(1e-30))
        room[_X, cell], room[_Y, cell], room[_Z, cell] = a * part, b * part, c * part
    B = len(room) - _BASIS
    if B <= 9:
        _low_basis(room, count, B)
    else:
        for cell in range(count):
            compiled_fill_basis(room[_X, cell], room[_Y, cell], room[_Z, cell], B, room[_BASIS:, cell])


@compiled()
def _low_basis(room: Singles, count: Whole, B: int) -> None:
    """kernels.march.sh.fill_basis() up to the second band, in one go: six times as fast."""
    for cell in range(np.uint64(count)):
        room[4, cell] = np.float32(_K0)
    if B > 1:
        for cell in range(np.uint64(count)):
            room[5, cell] = np.float32(-_K1) * room[_Y, cell]
            room[6, cell] = np.float32(_K1) * room[_Z, cell]
            room[7, cell] = np.float32(-_K1) * room[_X, cell]
    if B > 4:
        for cell in range(np.uint64(count)):
            x, y, z = room[_X, cell], room[_Y, cell], room[_Z, cell]
            room[8, cell] = np.float32(_K2) * x * y
            room[9, cell] = np.float32(-_K2) * y * z
            room[10, cell] = np.float32(_K20) * (np.float32(2) * z * z - x * x - y * y)
            room[11, cell] = np.float32(-_K2) * x * z
            room[12, cell] = np.float32(_K2 / 2) * (x * x - y * y)


@compiled()
def _colour(
    values: Singles,
    first: Whole,
    count: Whole,
    B: int,
    room: Singles,
    rows: Singles,
    task: Whole,
    base: Whole,
    channel: int,
) -> None:
    """One channel of a brick's cells as they look."""
    start, cells, into = np.uint64(first), np.uint64(count), np.uint64(base)
    for cell in range(cells):
        room[_SUM, cell] = np.float32(0)
    for k in range(B):
        for cell in range(cells):
            room[_SUM, cell] += room[_BASIS + k, cell] * values[start + cell]
        start += cells
    for cell in range(cells):
        room[_SUM, cell] = squash(room[_SUM, cell])
    for cell in range(cells):
        rows[task, into + cell, channel] = room[_SUM, cell]


@compiled()
def _fill(
    values: Singles,
    start: Whole,
    places: Any,
    first: Whole,
    count: Whole,
    width: float,
    rows: Singles,
    task: Whole,
    base: Whole,
) -> None:
    """Densities, and zeros where sums will be."""
    part, half = np.float32(1 / width), np.float32(0.5 / width)
    value, place, into = np.uint64(start), np.uint64(first), np.uint64(base)
    for cell in range(np.uint64(count)):
        rows[task, into + cell, SIGMA] = values[value + cell] * (half if places[place + cell] & 1 else part)
        for k in range(SIGMA + 1, ROW):
            rows[task, into + cell, k] = np.float32(0)


@compiled(merged=True)
def squash(x: Any) -> Any:
    """1 / (1 + e^-x) of a float32, to five digits: (e^(-x / 64))^64."""
    y = min(max(x, np.float32(-16)), np.float32(16)) * np.float32(-1 / 64)
    e = np.float32(1 / 24) + y * np.float32(1 / 120)
    e = np.float32(1) + y * (np.float32(1) + y * (np.float32(1 / 2) + y * (np.float32(1 / 6) + y * e)))
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    e = e * e
    return np.float32(1) / (np.float32(1) + e)
