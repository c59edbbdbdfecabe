"""Smaller pictures: the means of blocks of pixels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import as_input
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

Pixels = npt.NDArray[np.uint8]


def reduced_picture(pixels: Pixels, factor: int) -> Pixels:
    """(H, W, 4) -> (H // factor, W // factor, 4): the means of factor x factor pixels, rounded, as in Camera.reduced().

    Alpha weights the colours, and is 255 only where all of the pixels have it.
    """
    out = np.empty((pixels.shape[0] // factor, pixels.shape[1] // factor, 4), np.uint8)
    _reduce(as_input(pixels), factor, out)
    return out


@on_every_core
@compiled()
def _reduce(core: int, cores: int, pixels: Pixels, factor: int, out: Pixels) -> None:
    count = factor * factor
    for y in range(core, out.shape[0], cores):
        for x in range(out.shape[1]):
            red, green, blue, weight, whole = 0, 0, 0, 0, True
            for j in range(y * factor, (y + 1) * factor):
                for i in range(x * factor, (x + 1) * factor):
                    alpha = int(pixels[j, i, 3])
                    red += alpha * pixels[j, i, 0]
                    green += alpha * pixels[j, i, 1]
                    blue += alpha * pixels[j, i, 2]
                    weight += alpha
                    whole &= alpha == 255
            half, total = weight // 2, max(weight, 1)
            out[y, x, 0], out[y, x, 1] = (red + half) // total, (green + half) // total
            out[y, x, 2] = (blue + half) // total
            out[y, x, 3] = 255 if whole else min((weight + count // 2) // count, 254)
