"""Build an octree from cubes of any power-of-two size, such as VDB voxels and tiles. Each cube stays one leaf."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.octree.lookup import dilate
from nerfbake.kernels.octree.node_values import LeafRows, NodeRows
from nerfbake.kernels.octree.pyramid import INNER, Level, children_table, mean_edge, merge_equal
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import OctreeFrame

_WORK_BYTES = 64  # per leaf, for its position and its nodes, while the levels are computed


class Block(NamedTuple):
    """Cubes of 2^height voxels: their lowest voxels low (q, 3) int64, and the row of values of each cube, row (q,)."""

    low: Ints
    height: int
    row: Ints


def blocks_of(topology: VdbTopology, held: npt.NDArray[np.bool_]) -> list[Block]:
    """Return the voxels and tiles of a topology that are not empty, grouped by size; held (count,) selects them."""
    cubes, first, blocks = [(topology.coords, 1), *topology.tile_cubes], 0, []
    for low, edge in cubes:
        row = first + np.flatnonzero(held[first : first + len(low)])
        if len(row):
            blocks.append(Block(low[row - first].astype(np.int64), edge.bit_length() - 1, row))
        first += len(low)
    return blocks


def octree_of_blocks(blocks: list[Block], data: npt.NDArray[Any], frame: OctreeFrame) -> SparseVoxelOctree:
    """Return the octree whose leaves are these cubes. data (rows, D): their values, density last.

    Cubes must not overlap or extend beyond the frame. Eight equal siblings are merged to one leaf. Inner nodes store
    the mean of their children by the rule of build_octree(), with the voxel width instead of the finest cell's width.
    """
    count = sum(len(block.low) for block in blocks)
    memory.require("the octree", count * (data.shape[1] * data.itemsize + _WORK_BYTES))
    leaves = LeafRows(data, mean_edge(frame.voxel_size))
    height = max(edge - 1 for edge in frame.size).bit_length()
    levels = merge_equal(_levels(blocks, height), leaves.same)
    return SparseVoxelOctree(
        size=frame.size,
        node_children=children_table(levels, all_slots=frame.layout == "full"),
        node_data=NodeRows(levels, leaves),
        data_format=frame.data_format,
        origin=frame.origin,
        voxel_size=frame.voxel_size,
        extra_data=frame.extra_data,
    )


def _levels(blocks: list[Block], height: int) -> list[Level]:
    """Return all levels of a root of 2^height voxels, breadth-first, without nodes that have no leaf below them."""
    own = {block.height: _sorted(block) for block in blocks}
    codes, rows = np.zeros(0, np.int64), []
    for level in range(height + 1):
        above = codes >> 3
        codes = above[np.diff(above, prepend=-1) != 0]
        if level in own:
            codes = np.sort(np.concatenate([codes, own[level][0]]))
        rows.append(codes)
    levels = [Level(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.full(1, INNER, np.int32))]
    for above, below in pairwise(rows[::-1]):
        if not len(below):
            break
        parent = np.searchsorted(above, below >> 3).astype(np.int32)
        levels.append(Level(parent, (below & 7).astype(np.uint8), np.full(len(below), INNER, np.int32)))
    for level, (leaf_codes, row) in own.items():
        place = np.searchsorted(rows[level], leaf_codes)
        levels[height - level].leaf[place] = row.astype(np.int32)
    return levels


def _sorted(block: Block) -> tuple[Ints, Ints]:
    """Return the Morton codes of the cubes at their level, in ascending order, and the cubes' rows."""
    x, y, z = (dilate(block.low[:, axis] >> block.height) for axis in range(3))
    codes = x | y << 1 | z << 2
    order = np.argsort(codes)
    return codes[order], block.row[order]
