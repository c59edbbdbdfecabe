"""Plenoxels as svox2's own program turns them into a PlenOctree: the coefficients as they are, a cell for each node."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.octree.halves import widened
from nerfbake.scene.lattice_field import LatticeField, ShColour
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import OctreeFrame
from nerfbake.stages._cube_levels import Block, octree_of_blocks


def copied(lattice: LatticeField) -> SparseVoxelOctree:
    """An octree with the node's density and coefficients in each cell, where the density is above 0: what are sums cut
    at 0 there are shown through a sigmoid here. svox2's to_svox1 does so (its issue 22: greyish)."""
    assert isinstance(lattice.colour, ShColour)
    cells = np.argwhere(lattice.links >= 0)
    rows = lattice.links[tuple(cells.T)]
    held = lattice.density[rows] > 0
    cells, rows = cells[held], rows[held]
    values = np.concatenate([widened(lattice.features[rows]), lattice.density[rows, None]], axis=1).astype(np.float32)
    edges = (lattice.box[1] - lattice.box[0]) / lattice.shape
    frame = OctreeFrame(lattice.shape, f"SH{lattice.colour.size}", "full", lattice.box[0].copy(), edges)
    return octree_of_blocks([Block(cells.astype(np.int64), 0, np.arange(len(cells)))], values, frame)
