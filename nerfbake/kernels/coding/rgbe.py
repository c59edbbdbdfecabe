"""Rows of Radiance pictures: run-length coded or flat bytes -> (H, W, 4)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

_LEAST, _MOST = 8, 0x7FFF  # widths of rows with runs


@compiled()
def unpack_rows(body: npt.NDArray[np.uint8], out: npt.NDArray[np.uint8]) -> int:
    """Fill (H, W, 4) from the bytes of all rows. Return the first row that is not whole, or -1.

    A flat row with the pixel (1, 1, 1), which marks a run of Radiance's first coding, is not whole: no program writes
    this pixel for a colour, because its exponent would be lower.
    """
    H, W, _ = out.shape
    at, size = 0, len(body)
    for y in range(H):
        if _LEAST <= W <= _MOST and at + 4 <= size and body[at] == 2 and body[at + 1] == 2 and body[at + 2] < 128:
            if body[at + 2] * 256 + body[at + 3] != W:
                return y
            at += 4
            for channel in range(4):
                x = 0
                while x < W:
                    if at + 2 > size:
                        return y
                    count = int(body[at])
                    run = count > 128
                    count = count - 128 if run else count
                    needed = 1 if run else count
                    if count == 0 or x + count > W or at + 1 + needed > size:
                        return y
                    for k in range(count):
                        out[y, x + k, channel] = body[at + 1 + (0 if run else k)]
                    x += count
                    at += 1 + needed
            continue
        if at + 4 * W > size:
            return y
        for x in range(W):
            for channel in range(4):
                out[y, x, channel] = body[at + channel]
            if body[at] == 1 and body[at + 1] == 1 and body[at + 2] == 1:
                return y
            at += 4
    return -1
