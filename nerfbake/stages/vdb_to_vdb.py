"""VDB grids -> the same grids in fewer bytes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import Volume
from nerfbake.stages._half import rounded


def halve_volume(volume: Volume) -> Volume:
    """The volume with float16 values. Raises InvalidScene, naming the grid, where they do not fit."""

    def halved(grid: VdbTree | IndexGrid) -> VdbTree | IndexGrid:
        half, what = np.dtype(np.float16), f"grid {grid.name!r}"
        if isinstance(grid, IndexGrid):
            return replace(grid, table=rounded(grid.table, half, what=what, asked="--half"))
        background = rounded(grid.background, half, what=what, asked="--half").astype(np.float32)
        return replace(grid, values=rounded(grid.values, half, what=what, asked="--half"), background=background)

    return replace(volume, grids=tuple(map(halved, volume.grids)))
