"""The small octree that leads down to equal cubes, wherever they stand."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.march.cells import EMPTY
from nerfbake.kernels.octree.morton import dilate


def tile_levels(tiles: Ints, number: Ints, *, height: int | None = None) -> list[npt.NDArray[Any]]:
    """Octree levels (nodes, 8) down to tiles (u, 3) from 0 on, with the number of each; none where there is one tile.

    height: how many levels; None: as few as it takes.
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
