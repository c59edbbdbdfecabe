"""Sparse voxel octree -> VDB grids: density, colour, SH coefficients, or all of it behind one index."""

from __future__ import annotations

from math import prod

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.vdb.bricks import bricks_of
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame, Up, Volume
from nerfbake.stages._voxel_grids import WORK_BYTES, made_later, require_grids, volume_of_voxels

_VOXEL = 24  # bytes of its leaf's number and place, while bricks are made and sorted
_BRICK = 512  # bytes of 8^3 voxels' place and mask, of the leaf that they become, and of that in a file


def build_vdb(
    octree: SparseVoxelOctree,
    *,
    grids: tuple[str, ...] = ("density", "Cd"),
    half: bool = False,
    sigma_min: float | None = None,
    up: Up = "z",
) -> Volume:
    """The octree's voxels as grids over one topology.

    grids, any of these, `index` alone:
      density  float, 1/world unit
      Cd       colour, sRGB 0..1: the sigmoid of the SH's mean over all directions. Every basis function but the
               first averages to 0 over the sphere, so that mean is the first coefficient times 1 / (2 sqrt(pi)).
               (It is not the mean of the sigmoid, which no closed form gives; they agree where colour does not
               depend on the view.) RGBA has its colours as they are, behind the same sigmoid.
      sh       sh_0, sh_1, ...: the coefficients of red, green and blue of each basis function
      index    an IndexGrid with a table of all D values, density last

    Leaves above density 0 (and from sigma_min, 1/world unit) become voxels, large ones many; the rest is background,
    0. half: values are float16. up: the world's axis that the field's z becomes; `y` turns (x, y, z) into
    (x, z, -y) in the transform alone, voxels and SH stay as they are. Raises InvalidScene; MemoryLimit,
    before any voxel is made.

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
    sigma = np.ascontiguousarray(octree.sigma)  # a copy that lies together: a third of the time of each later read
    occupied = octree.childless & (sigma > 0) & (sigma >= (sigma_min or 0.0))
    densities = sigma if "density" in grids else None
    del sigma  # a large octree's index has no room for it
    # The table of an index is made from the rows of an octree's tree as it is written; other grids pick columns.
    rows = octree.node_rows if grids == ("index",) else octree.node_data
    dtype = np.dtype(np.float16 if half else np.float32)
    _require_room(octree, occupied, later=made_later(rows, dtype))
    bricks = bricks_of(octree.node_children, octree.level_sizes, occupied, octree.size)
    frame = OctreeFrame(
        octree.size, octree.data_format, octree.layout, octree.origin, octree.voxel_size, octree.extra_data
    )
    return memory.kept(volume_of_voxels(bricks, rows, densities, frame, grids=grids, dtype=dtype, up=up))


def _require_room(octree: SparseVoxelOctree, occupied: npt.NDArray[np.bool_], *, later: bool) -> None:
    """Raises MemoryLimit. Leaves that reach beyond the grid are counted whole, up to as many voxels as it has.

    later: their values are made as they are written; then bricks are counted, too, as nothing else takes more.
    """
    sizes, level = octree.level_sizes, octree.grid_level
    leaves = np.add.reduceat(occupied, np.cumsum([0, *sizes[:-1]]), dtype=np.int64).tolist()
    # Python's integers do not overflow.
    voxels = min(sum(count * 8 ** (level - depth) for depth, count in enumerate(leaves)), prod(octree.size))
    bricks = sum(count * 8 ** (level - 3 - depth) for depth, count in enumerate(leaves[: max(level - 3, 0)]))
    bricks = min(bricks + (sizes[level - 3] if 3 <= level < len(sizes) + 3 else 1), voxels)
    row = octree.data_dim * octree.node_rows.dtype.itemsize + WORK_BYTES
    memory.require("the octree as voxels", voxels * _VOXEL + bricks * _BRICK if later else voxels * row)
