"""VDB grids -> the same grids with values of another type."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np

from nerfbake import memory
from nerfbake.scene.vdb import IndexGrid, VdbTree
from nerfbake.scene.volume import Volume
from nerfbake.stages._voxel_grids import rounded


def cast_volume(volume: Volume, *, dtype: Literal["float16", "float32"]) -> Volume:
    """Convert the values of a volume's grids to this type.

    float32 leaves the table of an index grid unchanged. Raises InvalidScene, with the name of the grid, if values are
    too large for float16.

    >>> from nerfbake import build_octree, build_vdb, cast_volume, sample_n3tree
    >>> volume = build_vdb(build_octree(sample_n3tree(resolution=8)))
    >>> {grid.values.dtype.name for grid in cast_volume(volume, dtype="float16").grids}
    {'float16'}
    """
    wanted = np.dtype(dtype)

    def cast(grid: VdbTree | IndexGrid) -> VdbTree | IndexGrid:
        if isinstance(grid, IndexGrid):
            return grid if dtype == "float32" else replace(grid, table=rounded(grid.name, grid.table, wanted))
        background = rounded(grid.name, grid.background, wanted).astype(np.float32)
        return replace(grid, values=rounded(grid.name, grid.values, wanted), background=background)

    return memory.kept(replace(volume, grids=tuple(map(cast, volume.grids))))
