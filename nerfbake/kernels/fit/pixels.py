"""The pixels of a picture that a fit looks at, in the order in which neighbours share most of what they see."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles
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


@compiled()
def shrunk(picture: npt.NDArray[np.uint8], background: Floats, masked: bool, scale: int, out: Singles) -> None:
    """(H, W, 4) float32: the means of scale^2 pixels' colours over the background, 0..1, and alpha.

    Where alpha tells nothing, it is 1 where a pixel is not the background.
    """
    for y in range(out.shape[0]):
        for x in range(out.shape[1]):
            total = np.zeros(4)
            for j in range(scale):
                for i in range(scale):
                    pixel = picture[y * scale + j, x * scale + i]
                    alpha, differs = pixel[3] / 255, 0.0
                    for k in range(3):
                        colour = pixel[k] / 255
                        total[k] += colour * alpha + background[k] * (1 - alpha)
                        differs = max(differs, abs(colour - background[k]))
                    total[3] += alpha if masked else 1.0 if differs > _PLAIN else 0.0
            for k in range(4):
                out[y, x, k] = total[k] / (scale * scale)


@compiled()
def chosen(image: Singles, tiles: Ints, ring: int, pixels: npt.NDArray[np.int32]) -> int:
    """Fills in the numbers of the pixels with something in them, or within a ring around those; gives their count."""
    height, width, count = image.shape[0], image.shape[1], 0
    for tile in tiles:
        top, left = (tile >> 16) * TILE, (tile & 0xFFFF) * TILE
        for y in range(top, min(top + TILE, height)):
            for x in range(left, min(left + TILE, width)):
                held = False
                for j in range(max(y - ring, 0), min(y + ring + 1, height)):
                    for i in range(max(x - ring, 0), min(x + ring + 1, width)):
                        held |= image[j, i, 3] > 0
                if held:
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
