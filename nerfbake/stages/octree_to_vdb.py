"""Sparse voxel octree -> VDB grids: density, colour, SH coefficients, or one index grid with all values."""

from __future__ import annotations

from math import prod

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.vdb.bricks import bricks_of
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame, Up, Volume
from nerfbake.stages._voxel_grids import WORK_BYTES, is_lazy, require_grids, volume_of_voxels

_VOXEL = 24  # bytes per voxel, for its leaf's number and position while bricks are created and sorted
_BRICK = 512  # bytes per brick of 8^3 voxels, for its position and mask, its leaf node, and this node in a file


def build_vdb(
    octree: SparseVoxelOctree,
    *,
    grids: tuple[str, ...] = ("density", "Cd"),
    half: bool = False,
    sigma_min: float | None = None,
    up: Up = "z",
) -> Volume:
    """Convert an octree's voxels to grids with one common topology.

    grids: any of these, but `index` only on its own.

      density  float, 1/world unit
      Cd       colour, sRGB 0..1: the sigmoid of the SH's mean over all directions. Every basis function but the
               first averages to 0 over the sphere, so that mean is the first coefficient times 1 / (2 sqrt(pi)).
               (It is not the mean of the sigmoid, which has no closed form; both agree if the colour does not
               depend on the view.) RGBA colours go through the same sigmoid
      sh       sh_0, sh_1, ...: the coefficients of red, green and blue of each basis function
      index    an IndexGrid with a table of all D values, density last

    Leaves with a density above 0, and of at least sigma_min (1/world unit), become voxels; a large leaf becomes many.
    All other voxels are background, 0. half: store values as float16. up: the world's axis that the field's z becomes;
    `y` maps (x, y, z) to (x, z, -y) in the transform only, and does not change voxels and SH. Raises InvalidScene, and
    MemoryLimit before any voxel is created.

    >>> from nerfbake import build_octree, build_vdb, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> [grid.name for grid in build_vdb(octree).grids]
    ['density', 'Cd']
    >>> [grid.name for grid in build_vdb(octree, grids=("index",)).grids]
    ['index']
    """
    octree.require_usable()
    require_grids(grids, up, octree.data_format, octree.data_dim)
    if sigma_min is not None and not sigma_min >= 0:
        raise InvalidScene(Problem("sigma_min", f"is {sigma_min:g}", "0 or more"))
    sigma = np.ascontiguousarray(octree.sigma)  # a contiguous copy takes a third of the time of each later read
    occupied = octree.childless & (sigma > 0) & (sigma >= (sigma_min or 0.0))
    densities = sigma if "density" in grids else None
    del sigma  # frees memory for the index of a large octree
    # The table of an index grid is computed from the octree's rows while it is written; other grids select columns.
    rows = octree.node_rows if grids == ("index",) else octree.node_data
    dtype = np.dtype(np.float16 if half else np.float32)
    _require_room(octree, occupied, later=is_lazy(rows, dtype))
    bricks = bricks_of(octree.node_children, octree.level_sizes, occupied, octree.size)
    frame = OctreeFrame(
        octree.size, octree.data_format, octree.layout, octree.origin, octree.voxel_size, octree.extra_data
    )
    return memory.kept(volume_of_voxels(bricks, rows, densities, frame, grids=grids, dtype=dtype, up=up))


def _require_room(octree: SparseVoxelOctree, occupied: npt.NDArray[np.bool_], *, later: bool) -> None:
    """Raise MemoryLimit if the voxels do not fit into memory.

    Leaves that extend beyond the grid are counted with all their voxels, up to the size of the grid. later: values are
    computed while they are written; bricks are counted then, because they take the most memory.
    """
    sizes, level = octree.level_sizes, octree.grid_level
    leaves = np.add.reduceat(occupied, np.cumsum([0, *sizes[:-1]]), dtype=np.int64).tolist()
    # Python's integers do not overflow.
    voxels = min(sum(count * 8 ** (level - depth) for depth, count in enumerate(leaves)), prod(octree.size))
    bricks = sum(count * 8 ** (level - 3 - depth) for depth, count in enumerate(leaves[: max(level - 3, 0)]))
    bricks = min(bricks + (sizes[level - 3] if 3 <= level < len(sizes) + 3 else 1), voxels)
    row = octree.data_dim * octree.node_rows.dtype.itemsize + WORK_BYTES
    memory.require("the octree as voxels", voxels * _VOXEL + bricks * _BRICK if later else voxels * row)
