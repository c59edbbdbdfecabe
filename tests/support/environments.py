"""Small Radiance pictures, written here from the format's description."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

HEAD = b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y %d +X %d\n"


def pixels(height: int = 8) -> npt.NDArray[np.uint8]:
    """(H, 2 H, 4) bytes of colours and exponents."""
    found = np.random.default_rng(3).integers(128, 256, (height, 2 * height, 4), np.uint8)
    found[..., 3] = 120 + found[..., 3] % 16
    found[0, 0] = 0
    found[1, :9] = (200, 130, 140, 129)
    return found


def flat(height: int = 8) -> bytes:
    return HEAD % (height, 2 * height) + pixels(height).tobytes()


def runs(height: int = 8) -> bytes:
    """Each channel of a row as runs where values repeat, and as single values elsewhere."""
    out = [HEAD % (height, 2 * height)]
    for row in pixels(height):
        out.append(bytes([2, 2, len(row) >> 8, len(row) & 255]))
        for channel in row.T:
            x = 0
            while x < len(channel):
                end = x + 1
                while end < len(channel) and channel[end] == channel[x] and end - x < 127:
                    end += 1
                out.append(bytes([128 + end - x, channel[x]]) if end - x > 1 else bytes([1, channel[x]]))
                x = end
    return b"".join(out)
