"""The pixels that a fit uses, and the colours of a brick's cells as seen from the camera.

Pixels are ordered so that consecutive ones share most of the cells that their rays hit.
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Ints, Singles, as_input
from nerfbake.kernels.compiled import compiled_fill_basis
from nerfbake.kernels.fit.bricks import LOST, ROW, SIGMA, SIZE, BrickGrid, TaskBuffers, Whole
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.octree.lookup import dilate
from nerfbake.kernels.parallel import on_every_core

TILE = 8
_PLAIN = 3 / 255  # a colour that differs less from the background counts as background


def tile_order(width: int, height: int) -> Ints:
    """(tiles,) row << 16 | column of each tile of 8 x 8 pixels, along a Morton curve."""
    rows, columns = (np.arange((edge + TILE - 1) // TILE) for edge in (height, width))
    row, column = (each.reshape(-1) for each in np.meshgrid(rows, columns, indexing="ij"))
    order = np.argsort(dilate(row) << 1 | dilate(column), kind="stable")
    return (row << 16 | column)[order]


def downscale(picture: npt.NDArray[np.uint8], background: Floats, masked: bool, scale: int, out: Singles) -> None:
    """Fill `out` (H, W, 4) float32: means of the colours of scale^2 pixels over the background, 0..1, and of alpha.

    If alpha carries no information (masked is False), a pixel counts as opaque where it differs from the background.
    """
    _shrink(as_input(picture), background, masked, scale, out)


@on_every_core
@compiled()
def _shrink(
    core: int, cores: int, picture: npt.NDArray[np.uint8], background: Floats, masked: bool, scale: int, out: Singles
) -> None:
    for y in range(core, out.shape[0], cores):
        ground0, ground1, ground2 = background[0], background[1], background[2]
        for x in range(out.shape[1]):
            red, green, blue, held = 0.0, 0.0, 0.0, 0.0
            for j in range(scale):
                for i in range(scale):
                    row, column = y * scale + j, x * scale + i
                    alpha = picture[row, column, 3] / 255
                    c0 = picture[row, column, 0] / 255
                    c1 = picture[row, column, 1] / 255
                    c2 = picture[row, column, 2] / 255
                    red += c0 * alpha + ground0 * (1 - alpha)
                    green += c1 * alpha + ground1 * (1 - alpha)
                    blue += c2 * alpha + ground2 * (1 - alpha)
                    differs = max(abs(c0 - ground0), abs(c1 - ground1), abs(c2 - ground2))
                    held += alpha if masked else 1.0 if differs > _PLAIN else 0.0
            out[y, x, 0], out[y, x, 1] = red / (scale * scale), green / (scale * scale)
            out[y, x, 2], out[y, x, 3] = blue / (scale * scale), held / (scale * scale)


@compiled()
def number_pixels(held: Bits, tiles: Ints, pixels: npt.NDArray[np.int32]) -> int:
    """Write the numbers of the pixels that are set in `held` (H, W), tile by tile; return their count."""
    height, width, count = held.shape[0], held.shape[1], 0
    for tile in tiles:
        top, left = (tile >> 16) * TILE, (tile & 0xFFFF) * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                if held[y, x]:
                    pixels[count] = y * width + x
                    count += 1
    return count


@compiled()
def pinhole_directions(
    pixels: npt.NDArray[np.int32], width: int, optics: Floats, turn: Floats, samples: int, tilt: float, out: Singles
) -> None:
    """Fill `out` (pixels samples^2, 3) with unit directions at fixed places in each pixel.

    optics: fx, fy, cx, cy; turn (3, 3): the axes of the camera in the world, as columns, of any length. tilt: a place
    (x, y) from the middle of its pixel moves by tilt (y, -x).
    """
    ray = 0
    for pixel in pixels:
        for j in range(samples):
            for i in range(samples):
                across = (i + 0.5) / samples + tilt * ((j + 0.5) / samples - 0.5)
                down = (j + 0.5) / samples - tilt * ((i + 0.5) / samples - 0.5)
                x = (pixel % width + across - optics[2]) / optics[0]
                y = -(pixel // width + down - optics[3]) / optics[1]
                v0 = x * turn[0, 0] + y * turn[0, 1] - turn[0, 2]
                v1 = x * turn[1, 0] + y * turn[1, 1] - turn[1, 2]
                v2 = x * turn[2, 0] + y * turn[2, 1] - turn[2, 2]
                part = 1 / np.sqrt(v0 * v0 + v1 * v1 + v2 * v2)
                out[ray, 0], out[ray, 1], out[ray, 2] = v0 * part, v1 * part, v2 * part
                ray += 1


_K0, _K1, _K2, _K20 = 0.5 / sqrt(pi), sqrt(3 / (4 * pi)), sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
_K30, _K31 = sqrt(7 / (16 * pi)), sqrt(21 / (32 * pi))
_K32, _K33 = sqrt(105 / (4 * pi)), sqrt(35 / (32 * pi))
_X, _Y, _Z, _SUM, _BASIS = 0, 1, 2, 3, 4  # rows of the buffer


@compiled()
def new_colour_buffer(B: int) -> Singles:
    """Allocate a buffer (4 + B, 512) for the directions, a sum, and the basis of a brick's cells."""
    return np.empty((_BASIS + B, SIZE), np.float32)


@compiled()
def fill_brick_rows(
    bricks: BrickGrid,
    batch: TaskBuffers,
    task: Whole,
    brick: Whole,
    shell: Whole,
    at: Any,
    eye: Floats,
    room: Singles,
    more: Whole,
) -> Whole:
    """Fill the rows of a brick's cells. Return the number of the first row, or LOST if the capacity is exceeded.

    at (3,) int: the brick in the grid of its shell; eye (3,) in the world; room: a buffer of new_colour_buffer().
    more: number of further rows that are reserved behind those of the cells.
    """
    first, count = np.int64(bricks.first[brick]), np.int64(bricks.first[brick + 1] - bricks.first[brick])
    base = batch.used[task]
    batch.used[task] = base + count + more
    if base + count + more > batch.rows.shape[1]:
        batch.base[task, brick] = LOST
        return np.int64(LOST)
    batch.base[task, brick] = base
    B, low, size = len(room) - _BASIS, bricks.low, bricks.size
    x = np.float32(low[shell, 0] + 8 * at[0] * size[shell, 0] - eye[0])
    y = np.float32(low[shell, 1] + 8 * at[1] * size[shell, 1] - eye[1])
    z = np.float32(low[shell, 2] + 8 * at[2] * size[shell, 2] - eye[2])
    dx, dy, dz = np.float32(size[shell, 0]), np.float32(size[shell, 1]), np.float32(size[shell, 2])
    evaluate_basis(bricks.places, first, count, x, y, z, dx, dy, dz, room)
    start = (3 * B + 1) * first
    for channel in range(3):
        _colour(bricks.values, start + channel * B * count, count, B, room, batch.rows, task, base, channel)
    densities, width = start + 3 * B * count, float(bricks.width[shell])
    _fill(bricks.values, densities, bricks.places, first, count, width, batch.rows, task, base)
    return np.int64(base)


# Indices below are unsigned: numba checks signed ones for being negative, which also prevents vectorisation.
@compiled()
def evaluate_basis(
    places: Any, first: Whole, count: Whole, x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any, room: Singles
) -> None:
    """Evaluate the basis in the directions to the centres of a brick's cells.

    x, y, z: the vector from the camera to the corner of the brick; dx, dy, dz: the size of a cell; all float32.
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
    if B <= 16:
        _low_basis(room, count, B)
    else:
        for cell in range(count):
            compiled_fill_basis(room[_X, cell], room[_Y, cell], room[_Z, cell], B, room[_BASIS:, cell])


@compiled()
def _low_basis(room: Singles, count: Whole, B: int) -> None:
    """kernels.march.sh.fill_basis() up to the third band, for all cells at once: six times as fast."""
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
    if B > 9:
        for cell in range(np.uint64(count)):
            x, y, z = room[_X, cell], room[_Y, cell], room[_Z, cell]
            xx, yy, zz = x * x, y * y, z * z
            room[13, cell] = np.float32(-_K33) * y * (np.float32(3) * xx - yy)
            room[14, cell] = np.float32(_K32) * x * y * z
            room[15, cell] = np.float32(-_K31) * y * (np.float32(4) * zz - xx - yy)
            room[16, cell] = np.float32(_K30) * z * (np.float32(2) * zz - np.float32(3) * (xx + yy))
            room[17, cell] = np.float32(-_K31) * x * (np.float32(4) * zz - xx - yy)
            room[18, cell] = np.float32(_K32 / 2) * z * (xx - yy)
            room[19, cell] = np.float32(-_K33) * x * (xx - np.float32(3) * yy)


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
    """Compute one channel of the colours of a brick's cells."""
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
    """Write densities, and zeros for the sums."""
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
