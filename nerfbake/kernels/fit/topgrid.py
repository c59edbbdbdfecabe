"""The grid of bricks: which brick stands where, and how far the next one is from where there is none."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits
from nerfbake.kernels.dilation import dilated

Top = npt.NDArray[np.int32]


def top_grid(held: Bits) -> Top:
    """(r, r, r) int32 of (r, r, r) bool: bricks are numbered in raster order; elsewhere stands -d, where the nearest
    brick is d bricks away (Chebyshev), so that a ray may pass d - 1 further bricks in every direction.

    Without any brick d is r everywhere.
    """
    r = len(held)
    top = np.full(held.shape, -r, np.int32)
    near = held.copy()
    for away in range(1, r):
        wider = dilated(near)
        top[wider & ~near] = -away
        if wider.all() or not wider.any():
            break
        near = wider
    top[held] = np.arange(np.count_nonzero(held), dtype=np.int32)
    return top
