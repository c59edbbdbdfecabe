"""Build the levels of a small octree above tiles of equal size."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.march.cells import EMPTY
from nerfbake.kernels.octree.lookup import dilate


def tile_levels(tiles: Ints, number: Ints, *, height: int | None = None) -> list[npt.NDArray[Any]]:
    """Return octree levels (nodes, 8) above tiles at (u, 3), coordinates from 0; the last level stores their numbers.

    height: number of levels; None: as few as possible, which is none for a single tile at the origin.
    """
    height = int(tiles.max(initial=0)).bit_length() if height is None else height
    x, y, z = (dilate(tiles[:, axis]) for axis in range(3))
    below = x << 2 | y << 1 | z
    levels: list[npt.NDArray[Any]] = []
    for _ in range(height):
        above, parent = np.unique(below >> 3, return_inverse=True)
        table = np.full((len(above), 8), EMPTY, np.int32)
        table[parent, below & 7] = number
        levels.insert(0, table)
        below, number = above, np.arange(len(above))
    return levels
