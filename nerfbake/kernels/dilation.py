"""Dilation of boolean voxel grids."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Bits


def dilated(held: Bits) -> Bits:
    """Return the grid (X, Y, Z) with the 26 neighbours of each set cell (8 if an axis has length 1)."""
    wider = held
    for axis in range(3):
        along = np.moveaxis(wider, axis, 0)
        grown = along.copy(order="K")
        grown[1:] |= along[:-1]
        grown[:-1] |= along[1:]
        wider = np.moveaxis(grown, 0, axis)
    return wider
