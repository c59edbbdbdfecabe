"""Map pixels to the nearest colours of a palette, and draw short titles.

The letters have five by seven dots; only those that titles need are available.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

HEIGHT, ADVANCE = 7, 6  # height of a letter, and distance to the next one, in dots

# Each number is a row of five dots, from the top; the highest bit is the left dot.
_LETTERS = {
    " ": (0, 0, 0, 0, 0, 0, 0),
    "-": (0, 0, 0, 31, 0, 0, 0),
    "2": (14, 17, 1, 6, 8, 16, 31),
    "8": (14, 17, 17, 14, 17, 17, 14),
    "H": (17, 17, 17, 31, 17, 17, 17),
    "I": (14, 4, 4, 4, 4, 4, 14),
    "N": (17, 25, 21, 19, 17, 17, 17),
    "R": (30, 17, 17, 30, 20, 18, 17),
    "T": (31, 4, 4, 4, 4, 4, 4),
    "U": (17, 17, 17, 17, 17, 17, 14),
    "X": (17, 17, 10, 4, 10, 17, 17),
}


def letter_dots(text: str) -> npt.NDArray[np.bool_]:
    """(7, 6 len(text)) bool: the dots of a text of these letters."""
    rows = np.array([_LETTERS[letter] for letter in text], np.uint8).reshape(-1, HEIGHT)
    dots = np.unpackbits(rows[..., None], axis=2)[..., 3:].astype(bool)  # (letters, 7, 5)
    return np.pad(dots, ((0, 0), (0, 0), (0, ADVANCE - 5))).transpose(1, 0, 2).reshape(HEIGHT, -1)


ALL_COLOURS = 1 << 24
UNKNOWN = -1


def nearest_colour(
    pixels: npt.NDArray[np.uint8], palette: npt.NDArray[np.uint8], known: npt.NDArray[np.int16]
) -> npt.NDArray[np.uint8]:
    """(m,) uint8: the palette colour (K <= 256, 3) closest to each pixel (m, 3), the first of equally close ones.

    known (ALL_COLOURS,): a cache for one palette, filled with UNKNOWN at first; each colour is searched only once.
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
