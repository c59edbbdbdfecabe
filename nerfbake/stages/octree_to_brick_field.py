"""Sparse voxel octree -> field of bricks, whose cells are the octree's leaves."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.fit.bricks import top_grid
from nerfbake.kernels.vdb.bitmask import bits_of
from nerfbake.kernels.vdb.bricks import bricks_of
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.octree import SparseVoxelOctree

_CELL_BYTES = 16  # per slot of a brick, while cells are numbered
_ODD = 1 << 6 | 1 << 3 | 1  # the bits of a slot that give the position of a cell in its block of 2^3


def build_bricks(octree: SparseVoxelOctree) -> BrickField:
    """Convert the leaves with a density above 0 to cells, in a lattice over the root's cube of at least 8^3 cells.

    A leaf of the last level becomes a cell, and a leaf of the level above a wide cell. A larger leaf becomes several
    wide cells, which all store its values. Cells outside the octree's grid are dropped. Raises InvalidScene for a
    broken octree and for other bases than SH; MemoryLimit.

    >>> from nerfbake import build_bricks, build_octree, sample_n3tree
    >>> print(build_bricks(build_octree(sample_n3tree(resolution=8))))
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
    """Return (n,) bool: the nodes above the level of single voxels."""
    sizes = octree.level_sizes
    above = np.ones(octree.n, bool)
    if len(sizes) > octree.grid_level:
        above[-sizes[-1] :] = False
    return above


def _numbered(node: npt.NDArray[np.int32], above: npt.NDArray[np.bool_]) -> tuple[npt.NDArray[np.int32], Ints]:
    """Return the rows of a BrickField, numbered in order of first occurrence, and the node of each (n,).

    node (b, 512): the octree's node of each cell, -1 for an empty cell. above (nodes,): nodes whose cells are wide.
    """
    held = node >= 0
    wide = np.zeros(node.shape, bool)
    wide[held] = above[node[held]]
    # A leaf that the boundary of the grid cuts becomes single cells there.
    blocks = held.reshape(-1, 4, 2, 4, 2, 4, 2).all(axis=(2, 4, 6), keepdims=True)
    wide &= np.broadcast_to(blocks, (len(node), 4, 2, 4, 2, 4, 2)).reshape(node.shape)
    # The first occurrence of a wide cell is its lowest cell, where the slot's odd bits are 0.
    slots = np.arange(512)
    first = held & ~(wide & (slots & _ODD != 0))
    number = np.cumsum(first, dtype=np.int32).reshape(node.shape) - 1
    number = np.where(wide, number[:, slots & ~_ODD], number)
    return np.where(held, number << 1 | wide, -1).astype(np.int32), node[first].astype(np.int64)
