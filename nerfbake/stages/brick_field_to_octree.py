"""Field of bricks -> sparse voxel octree: a new one whose leaves are the cells, or an existing one with new values."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.octree import haar
from nerfbake.kernels.octree.lookup import dilate, octree_nodes
from nerfbake.kernels.octree.node_values import LeafRows, NodeRows
from nerfbake.kernels.octree.pyramid import mean_edge, mean_of_runs, opacity
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.octree import Layout, SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame
from nerfbake.stages._cube_levels import Block, octree_of_blocks
from nerfbake.stages.half import cast_values


def build_octree_from_bricks(field: BrickField, *, layout: Layout = "full") -> SparseVoxelOctree:
    """Convert a field of bricks to an octree over its lattice. Each cell becomes a leaf of its size with its values.

    Of a field with shells, the inner cube is converted. Cells of density 0 have no nodes, and eight equal siblings are
    merged to one leaf. Inner nodes store the mean of the leaves below them by the rule of build_octree(), as if the
    octree was built from the field's PlenOctree. Raises InvalidScene for a broken field; MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import BrickField, build_octree_from_bricks
    >>> from nerfbake.scene.basis import Basis
    >>> rows = np.full((1, 512), -1, np.int32)
    >>> rows[0, 0] = 0
    >>> grey, box = np.array([[0, 0, 0, 50]], np.float32), np.array([[0.0] * 3, [1.0] * 3])
    >>> octree = build_octree_from_bricks(BrickField(8, box, Basis("SH", 1), np.zeros((1, 1, 1), np.int32), rows, grey))
    >>> octree.level_sizes, octree.node_data[:, 3].tolist()
    ([1, 1, 1, 1], [0.09765625, 0.78125, 6.25, 50.0])
    """
    field.require_usable()
    field = field.shell(0)
    filled = field.values[:, -1] > 0
    blocks = []
    for height, chosen in enumerate((filled & ~field.wide, filled & field.wide)):
        row = np.flatnonzero(chosen)
        if len(row):
            blocks.append(Block(field.corners[row].astype(np.int64), height, row))
    edge = field.resolution
    frame = OctreeFrame((edge, edge, edge), str(field.basis), layout, field.box[0].copy(), field.cell_size)
    return memory.kept(octree_of_blocks(blocks, field.values, frame))


def fill_octree(octree: SparseVoxelOctree, field: BrickField) -> SparseVoxelOctree:
    """Return the octree with the values of a field whose cells are those of build_bricks(octree), or some of them.

    The octree keeps its nodes. A leaf with several cells stores their mean by the rule of build_octree(); a leaf
    without cells is empty. Inner nodes are recomputed by the same rule, with the voxel width instead of the finest
    cell's width. Raises InvalidScene for a field in another lattice or basis, or with cells outside the leaves, and
    for values that are too large for the octree's float16.

    >>> from nerfbake import build_bricks, build_octree, fill_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> back = fill_octree(octree, build_bricks(octree))
    >>> bool((back.node_data[octree.childless] == octree.node_data[octree.childless]).all())
    True
    """
    octree.require_sound()
    field.require_usable()
    number = np.cumsum(octree.childless) - 1
    leaf = number[_leaves_around(octree, field)]
    width = mean_edge(octree.voxel_size)
    values = cast_values(
        _leaf_means(field, leaf, int(number[-1]) + 1, width), octree.node_rows.dtype, what="the field", asked="float16"
    )
    masks = np.packbits(octree.with_layout("full").node_children != 0, axis=1, bitorder="little")[:, 0]
    levels = haar.levels_of(masks, octree.grid_level)
    return memory.kept(replace(octree, node_data=NodeRows(levels, LeafRows(values, width))))


def _leaves_around(octree: SparseVoxelOctree, field: BrickField) -> Ints:
    """Return the octree's node (n,) around each cell. Raises InvalidScene."""
    resolution = max(8, 1 << octree.grid_level)
    box = np.stack([octree.origin, octree.origin + resolution * octree.voxel_size])
    same = field.resolution == resolution and np.array_equal(field.box, box)
    if not same or str(field.basis) != octree.data_format:
        allowed = f"{octree.data_format} in the octree's lattice of {resolution}^3"
        raise InvalidScene(Problem("the field", f"does not match the octree: {field}", allowed))
    inside = (field.corners < 1 << octree.grid_level).all(axis=1)
    x, y, z = (dilate(np.where(inside, field.corners[:, axis], 0).astype(np.int64)) for axis in range(3))
    node = octree_nodes(octree.node_children, octree.childless, octree.grid_level, x | y << 1 | z << 2)
    if (beside := np.flatnonzero((node < 0) | ~inside)).size:
        place = ", ".join(map(str, field.corners[beside[0]]))
        raise InvalidScene(Problem("the field", f"has a cell at ({place})", "cells in the octree's leaves"))
    return node


def _leaf_means(field: BrickField, leaf: Ints, leaves: int, width: float) -> Singles:
    """Return the values (leaves, D) of each leaf: its cell, or the mean of its cells.

    leaf (n,): the leaf of each cell. width: length for which the opacities that weight a mean are computed.
    """
    values, counts = np.zeros((leaves, field.basis.data_dim), np.float32), np.bincount(leaf, minlength=leaves)
    alone = counts[leaf] == 1
    values[leaf[alone]] = field.values[alone]
    several = np.flatnonzero(counts > 1)
    cells = np.flatnonzero(~alone)
    cells = cells[np.argsort(leaf[cells], kind="stable")]
    volume = np.where(field.wide, 8.0, 1.0)
    share = volume[cells] / np.bincount(leaf, volume, leaves)[leaf[cells]]
    means = np.empty((len(several), values.shape[1]), np.float32)
    weight = opacity(field.values[cells, -1], width)

    def rows_at(begin: int, end: int) -> npt.NDArray[np.float32]:
        return field.values[cells[begin:end]]

    mean_of_runs(rows_at, weight, share, counts[several], means)
    values[several] = means
    return values
