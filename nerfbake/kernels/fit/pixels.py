"""The pixels of a picture that a fit looks at, in the order in which neighbours share most of what they see."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.arrays import Bits, Floats, Ints, Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.octree.morton import dilate

TILE = 8
_PLAIN = 3 / 255  # a colour may differ so much from the background and still be it


def tile_order(width: int, height: int) -> Ints:
    """(tiles,) rows and columns of tiles of 8 x 8 pixels as row << 16 | column, along Morton's curve."""
    rows, columns = (np.arange((edge + TILE - 1) // TILE) for edge in (height, width))
    row, column = (each.reshape(-1) for each in np.meshgrid(rows, columns, indexing="ij"))
    order = np.argsort(dilate(row) << 1 | dilate(column), kind="stable")
    return (row << 16 | column)[order]


@compiled(parallel=True)
def shrunk(picture: npt.NDArray[np.uint8], background: Floats, masked: bool, scale: int, out: Singles) -> None:
    """(H, W, 4) float32: the means of scale^2 pixels' colours over the background, 0..1, and alpha.

    Where alpha tells nothing, it is 1 where a pixel is not the background.
    """
    for y in prange(out.shape[0]):
        _shrink_row(picture, background, masked, scale, y, out)


@compiled()
def _shrink_row(
    picture: npt.NDArray[np.uint8], background: Floats, masked: bool, scale: int, y: int, out: Singles
) -> None:
    ground0, ground1, ground2 = background[0], background[1], background[2]
    for x in range(out.shape[1]):
        red, green, blue, held = 0.0, 0.0, 0.0, 0.0
        for j in range(scale):
            for i in range(scale):
                row, column = y * scale + j, x * scale + i
                alpha = picture[row, column, 3] / 255
                c0, c1, c2 = picture[row, column, 0] / 255, picture[row, column, 1] / 255, picture[row, column, 2] / 255
                red += c0 * alpha + ground0 * (1 - alpha)
                green += c1 * alpha + ground1 * (1 - alpha)
                blue += c2 * alpha + ground2 * (1 - alpha)
                differs = max(abs(c0 - ground0), abs(c1 - ground1), abs(c2 - ground2))
                held += alpha if masked else 1.0 if differs > _PLAIN else 0.0
        out[y, x, 0], out[y, x, 1] = red / (scale * scale), green / (scale * scale)
        out[y, x, 2], out[y, x, 3] = blue / (scale * scale), held / (scale * scale)


@compiled()
def chosen(held: Bits, tiles: Ints, pixels: npt.NDArray[np.int32]) -> int:
    """Fills in the numbers of the pixels that are held (H, W), tile by tile; gives their count."""
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
def pinhole_looks(
    pixels: npt.NDArray[np.int32], width: int, optics: Floats, turn: Floats, samples: int, out: Singles
) -> None:
    """out (pixels samples^2, 3): unit directions at fixed places in each pixel. optics: fx, fy, cx, cy; turn (3, 3):
    the camera's axes in the world, as columns.
    """
    ray = 0
    for pixel in pixels:
        for j in range(samples):
            y = -(pixel // width + (j + 0.5) / samples - optics[3]) / optics[1]
            for i in range(samples):
                x = (pixel % width + (i + 0.5) / samples - optics[2]) / optics[0]
                part = 1 / np.sqrt(x * x + y * y + 1)
                for axis in range(3):
                    out[ray, axis] = (x * turn[axis, 0] + y * turn[axis, 1] - turn[axis, 2]) * part
                ray += 1


def gathered(image: Singles, pixels: npt.NDArray[Any]) -> Singles:
    """(m, 4) of the pixels."""
    return np.asarray(image.reshape(-1, 4)[pixels], np.float32)
