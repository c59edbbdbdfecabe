"""Colours -> the nearest of a few."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

ALL_COLOURS = 1 << 24
UNKNOWN = -1


def nearest_colour(
    pixels: npt.NDArray[np.uint8], palette: npt.NDArray[np.uint8], known: npt.NDArray[np.int16]
) -> npt.NDArray[np.uint8]:
    """(m,) uint8: each pixel's (m, 3) closest colour of the palette (K <= 256, 3), the first of equals.

    known: (ALL_COLOURS,) full of UNKNOWN at first; what was found once for a palette is only looked up from then on.
    """
    found = np.empty(len(pixels), np.uint8)
    _nearest(pixels, palette.astype(np.int32), known, found)
    return found


@compiled()
def _nearest(
    pixels: npt.NDArray[np.uint8],
    palette: npt.NDArray[np.int32],
    known: npt.NDArray[np.int16],
    found: npt.NDArray[np.uint8],
) -> None:
    for i in range(len(pixels)):
        r, g, b = np.int32(pixels[i, 0]), np.int32(pixels[i, 1]), np.int32(pixels[i, 2])
        code = r << 16 | g << 8 | b
        if known[code] < 0:
            least = np.int32(1 << 30)
            for k in range(len(palette)):
                x, y, z = palette[k, 0] - r, palette[k, 1] - g, palette[k, 2] - b
                distance = x * x + y * y + z * z
                if distance < least:
                    least = distance
                    known[code] = k
        found[i] = known[code]
