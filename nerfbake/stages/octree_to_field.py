"""Octree -> the field that a marcher reads."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.kernels.march.cells import EMPTY, cells_of
from nerfbake.scene.basis import parse_basis, shown_basis
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.radiance_field import RadianceField, leaf_box


def field_of_octree(octree: SparseVoxelOctree) -> RadianceField:
    """Its leaves with a density above 0; a density alone is grey. Raises InvalidScene for what cannot be shown.

    >>> from nerfbake import build_octree, field_of_octree, sample_n3tree
    >>> print(field_of_octree(build_octree(sample_n3tree(resolution=8))))
    SH9 field of 167 leaves over 8^3 cells
    """
    octree.require_usable()
    # A density alone is grey, as it is in a volume.
    alone = octree.data_dim == 1 and not octree.data_format
    basis = parse_basis("RGBA") if alone else shown_basis(octree.data_format)
    leaves = octree.childless & (octree.sigma > 0)
    number = np.full(octree.n, EMPTY, np.int32)
    number[leaves] = -2 - np.arange(int(leaves.sum()), dtype=np.int32)
    inner = np.flatnonzero(~octree.childless)
    number[inner] = np.arange(len(inner))
    # The octree's octants are x + 2y + 4z, the cells' order is [x][y][z].
    children = octree.node_children[inner].reshape(-1, 2, 2, 2).transpose(0, 3, 2, 1).reshape(-1, 8)
    slots = np.where(children == 0, np.int32(EMPTY), number[children])
    if not len(inner):
        slots = np.full((1, 8), number[0], np.int32)
    cells = cells_of(slots, [1] * max(octree.grid_level, 1))
    # Cells are voxels, but halves of them where one voxel is all there is.
    scale = (cells.edge >> octree.grid_level) / octree.voxel_size
    place = np.column_stack([np.diag(scale), -octree.origin * scale])
    box = leaf_box(cells, np.array(octree.size) * (cells.edge >> octree.grid_level))
    values = octree.node_data[leaves].astype(np.float32)
    if alone:
        values = np.concatenate([np.zeros((len(values), 3), np.float32), values], axis=1)
    return memory.kept(RadianceField(cells, values, place, box, basis))
