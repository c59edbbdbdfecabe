"""Field of bricks -> sparse voxel octree: one whose leaves are the field's cells, or one that there was already."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.octree import haar
from nerfbake.kernels.octree.lookup import octree_nodes
from nerfbake.kernels.octree.means import mean_edge, mean_of_runs, opacity
from nerfbake.kernels.octree.morton import dilate
from nerfbake.kernels.octree.node_values import LeafRows, NodeRows
from nerfbake.scene.brick_field import BrickField
from nerfbake.scene.octree import Layout, SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame
from nerfbake.stages._cube_levels import Block, octree_of_blocks
from nerfbake.stages._half import rounded


def octree_of_bricks(field: BrickField, *, layout: Layout = "full") -> SparseVoxelOctree:
    """The same field as an octree over its lattice: each cell is a leaf at its own depth and keeps its values.

    Cells of density 0 have no nodes, and eight equal neighbours are one leaf. Inner nodes hold the mean of what is
    below them by build_octree's rule, as if they came from the field's PlenOctree. Raises InvalidScene for a broken
    field; MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import BrickField, octree_of_bricks
    >>> from nerfbake.scene.basis import Basis
    >>> rows = np.full((1, 512), -1, np.int32)
    >>> rows[0, 0] = 0
    >>> grey, box = np.array([[0, 0, 0, 50]], np.float32), np.array([[0.0] * 3, [1.0] * 3])
    >>> octree = octree_of_bricks(BrickField(8, box, Basis("SH", 1), np.zeros((1, 1, 1), np.int32), rows, grey))
    >>> octree.level_sizes, octree.node_data[:, 3].tolist()
    ([1, 1, 1, 1], [0.09765625, 0.78125, 6.25, 50.0])
    """
    field.require_usable()
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
    """The octree's own nodes with the field's values, whose cells are those of bricks_of_octree(octree), or some of
    them.

    A leaf of several cells holds their mean by build_octree's rule, and one without any is empty. Inner nodes are made
    anew by the same rule, with the voxel's width for the finest cell's. Raises InvalidScene for a field in another
    lattice or basis, or with cells beside the leaves, and for values that the octree's float16 cannot hold.

    >>> from nerfbake import bricks_of_octree, build_octree, fill_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=8))
    >>> back = fill_octree(octree, bricks_of_octree(octree))
    >>> bool((back.node_data[octree.childless] == octree.node_data[octree.childless]).all())
    True
    """
    octree.require_sound()
    field.require_usable()
    number = np.cumsum(octree.childless) - 1
    leaf = number[_leaves_around(octree, field)]
    width = mean_edge(octree.voxel_size)
    values = rounded(
        _leaf_means(field, leaf, int(number[-1]) + 1, width), octree.node_rows.dtype, what="the field", asked="float16"
    )
    masks = np.packbits(octree.with_layout("full").node_children != 0, axis=1, bitorder="little")[:, 0]
    levels = haar.levels_of(masks, octree.grid_level)
    return memory.kept(replace(octree, node_data=NodeRows(levels, LeafRows(values, width))))


def _leaves_around(octree: SparseVoxelOctree, field: BrickField) -> Ints:
    """(n,) the octree's node around each cell. Raises InvalidScene."""
    resolution = max(8, 1 << octree.grid_level)
    box = np.stack([octree.origin, octree.origin + resolution * octree.voxel_size])
    same = field.resolution == resolution and np.array_equal(field.box, box)
    if not same or str(field.basis) != octree.data_format:
        allowed = f"{octree.data_format} in the octree's lattice of {resolution}^3"
        raise InvalidScene(Problem("the field", f"is another: {field}", allowed))
    inside = (field.corners < 1 << octree.grid_level).all(axis=1)
    x, y, z = (dilate(np.where(inside, field.corners[:, axis], 0).astype(np.int64)) for axis in range(3))
    node = octree_nodes(octree.node_children, octree.childless, octree.grid_level, x | y << 1 | z << 2)
    if (beside := np.flatnonzero((node < 0) | ~inside)).size:
        place = ", ".join(map(str, field.corners[beside[0]]))
        raise InvalidScene(Problem("the field", f"has a cell at ({place})", "cells in the octree's leaves"))
    return node


def _leaf_means(field: BrickField, leaf: Ints, leaves: int, width: float) -> Singles:
    """(leaves, D) what is in each leaf: leaf (n,) tells where each cell is, width what a mean weighs opacities in."""
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
