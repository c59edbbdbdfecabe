"""Voxels and tiles of a VDB tree -> the levels of an octree that has them as leaves, without cutting a tile up."""

from __future__ import annotations

from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.octree.means import mean_edge
from nerfbake.kernels.octree.morton import dilate
from nerfbake.kernels.octree.node_values import LeafRows, NodeRows
from nerfbake.kernels.octree.pyramid import INNER, Level, children_table, merge_equal
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import OctreeFrame

_WORK_BYTES = 64  # a leaf's place and its nodes while the levels are made


class Block(NamedTuple):
    """low (q, 3) int64 lowest voxels of cubes that are 2^height voxels wide, and the row of values of each (q,)."""

    low: Ints
    height: int
    row: Ints


def blocks_of(topology: VdbTopology, held: npt.NDArray[np.bool_]) -> list[Block]:
    """The voxels and the tiles that hold something: held (count,)."""
    cubes, first, blocks = [(topology.coords, 1), *topology.tile_cubes], 0, []
    for low, edge in cubes:
        row = first + np.flatnonzero(held[first : first + len(low)])
        if len(row):
            blocks.append(Block(low[row - first].astype(np.int64), edge.bit_length() - 1, row))
        first += len(low)
    return blocks


def octree_of_blocks(blocks: list[Block], data: npt.NDArray[Any], frame: OctreeFrame) -> SparseVoxelOctree:
    """The octree of these cubes, none of which may overlap or reach beyond the frame; data (rows, D), density last.

    Eight equal neighbours are one leaf; inner nodes hold the mean of their children by build_octree's rule, with the
    voxel's width for the finest cell's.
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
    """All levels of a root 2^height voxels wide, breadth-first; what has no leaf below it is not there."""
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
    """Morton codes of the cubes at their own level, rising, and their rows."""
    x, y, z = (dilate(block.low[:, axis] >> block.height) for axis in range(3))
    codes = x | y << 1 | z << 2
    order = np.argsort(codes)
    return codes[order], block.row[order]
