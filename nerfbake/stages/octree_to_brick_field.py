"""Octree -> field of bricks, whose cells are the octree's leaves."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.fit.topgrid import top_grid
from nerfbake.kernels.vdb.bitmask import bits_of
from nerfbake.kernels.vdb.bricks import bricks_of
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.octree import SparseVoxelOctree

_CELL_BYTES = 16  # of a brick's place for a cell, while cells are numbered
_ODD = 1 << 6 | 1 << 3 | 1  # the bits of a slot that tell a cell from the others of its block of 2^3


def bricks_of_octree(octree: SparseVoxelOctree) -> BrickField:
    """The octree's leaves of a density above 0 as cells, in a lattice over its root's cube (of 8^3 cells at least).

    A leaf of the last level is a cell, one of the level above is a wide cell, and larger ones are as many wide cells
    as they are large, which all hold the leaf's values; what the grid's end cuts off is not there. Raises InvalidScene
    for a broken octree and for other bases than SH; MemoryLimit.

    >>> from nerfbake import bricks_of_octree, build_octree, sample_n3tree
    >>> print(bricks_of_octree(build_octree(sample_n3tree(resolution=8))))
    SH9 field of 167 cells in 1 brick of 8^3, in a lattice of 8^3
    """
    octree.require_usable()
    leaves = octree.childless & (octree.sigma > 0)
    bricks = bricks_of(octree.node_children, octree.level_sizes, leaves, octree.size)
    filled = np.flatnonzero(bricks.mask.any(axis=1))
    resolution = max(8, 1 << octree.grid_level)
    r = resolution // 8
    places = tuple(bricks.low[filled].T >> 3)
    order = filled[np.argsort(np.ravel_multi_index(places, (r, r, r)))]
    memory.require("the octree as bricks", len(order) * 512 * _CELL_BYTES)
    number = np.full((len(bricks.low), 512), -1, np.int32)
    number[bits_of(bricks.mask)] = bricks.node
    rows, node = _numbered(number[order], _above(octree))
    held = np.zeros((r, r, r), bool)
    held[tuple(bricks.low[order].T >> 3)] = True
    field = BrickField(
        resolution=resolution,
        box=np.stack([octree.origin, octree.origin + resolution * octree.voxel_size]),
        basis=parse_basis(octree.data_format),
        top=top_grid(held),
        rows=rows,
        values=octree.node_data[node].astype(np.float32, copy=False),
    )
    return memory.kept(field)


def _above(octree: SparseVoxelOctree) -> npt.NDArray[np.bool_]:
    """(n,) bool: the nodes above the level of single voxels."""
    sizes = octree.level_sizes
    above = np.ones(octree.n, bool)
    if len(sizes) > octree.grid_level:
        above[-sizes[-1] :] = False
    return above


def _numbered(node: npt.NDArray[np.int32], above: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int32], Ints]:
    """The rows of a BrickField, numbered as cells first meet them, and (n,) the node of each: node (b, 512), -1 for an
    empty cell; above (nodes,) those whose cells are wide."""
    held = node >= 0
    wide = np.zeros(node.shape, bool)
    wide[held] = above[node[held]]
    # A leaf that the grid's end cuts is cells of their own there.
    blocks = held.reshape(-1, 4, 2, 4, 2, 4, 2).all(axis=(2, 4, 6), keepdims=True)
    wide &= np.broadcast_to(blocks, (len(node), 4, 2, 4, 2, 4, 2)).reshape(node.shape)
    # A wide cell is first met in its lowest cell, where the slot's odd bits are 0.
    slots = np.arange(512)
    first = held & ~(wide & (slots & _ODD != 0))
    number = np.cumsum(first, dtype=np.int32).reshape(node.shape) - 1
    number = np.where(wide, number[:, slots & ~_ODD], number)
    return np.where(held, number << 1 | wide, -1).astype(np.int32), node[first].astype(np.int64)
