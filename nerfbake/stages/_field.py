"""Any octree as the marcher wants it: one table of slots, the values of what is not empty, and where it stands."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.traversal import EMPTY
from nerfbake.scene.basis import Basis, parse_basis
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree


class Field(NamedTuple):
    """kernels.traversal has slots and values; tree point = world * scale + offset."""

    N: int
    slots: npt.NDArray[np.int32]
    values: npt.NDArray[np.float32]
    scale: npt.NDArray[np.float64]
    offset: npt.NDArray[np.float64]
    basis: Basis

    def occupied_box(self) -> npt.NDArray[np.float64]:
        """(2, 3) world corners of the box around all leaves; of the whole cube where there are none."""
        low, high = np.ones(3), np.zeros(3)
        for corners, width in self._leaves():
            low = np.minimum(low, corners.min(axis=0))
            high = np.maximum(high, corners.max(axis=0) + width)
        if (low > high).any():
            low, high = np.zeros(3), np.ones(3)
        return (np.stack([low, high]) - self.offset) / self.scale

    def leaf_centres(self, most: int) -> npt.NDArray[np.float64]:
        """(m, 3) world centres of the leaves, evenly thinned out to `most`."""
        centres = [corners + width / 2 for corners, width in self._leaves()] or [np.empty((0, 3))]
        found = np.concatenate(centres)
        thinned = found[np.linspace(0, len(found) - 1, most).astype(int)] if len(found) > most else found
        return (thinned - self.offset) / self.scale

    def _leaves(self) -> Iterator[tuple[npt.NDArray[np.float64], float]]:
        """The low corners of each level's leaves (m, 3), in the cube [0, 1]^3, and their width."""
        nodes, place, width = np.zeros(1, np.int64), np.zeros((1, 3)), 1.0
        steps = np.stack(np.unravel_index(np.arange(self.N**3), (self.N,) * 3), axis=1)
        while len(nodes):
            width /= self.N
            cells = self.slots[nodes].reshape(-1)
            corner = (place[:, None] + steps * width).reshape(-1, 3)
            if (leaf := cells < EMPTY).any():
                yield corner[leaf], width
            nodes, place = cells[cells >= 0].astype(np.int64), corner[cells >= 0]


@lru_cache(maxsize=2)
def field_of(scene: N3Tree | SparseVoxelOctree) -> Field:
    """The scene made ready; kept for the next picture. Raises InvalidScene for a basis that cannot be shown."""
    for problem in scene.problems():
        raise InvalidScene(problem)
    if not scene.data_format:
        raise InvalidScene(Problem("data_format", "is not known", "SHk or RGBA"))
    basis = parse_basis(scene.data_format)
    if basis.kind not in ("SH", "RGBA"):
        raise InvalidScene(Problem("data_format", f"is {scene.data_format}", "SHk or RGBA can be rendered"))
    if isinstance(scene, N3Tree):
        return _of_n3tree(scene, basis)
    return _of_octree(scene, basis)


def _of_n3tree(tree: N3Tree, basis: Basis) -> Field:
    data = tree.data.reshape(-1, tree.data_dim)
    held = np.flatnonzero(tree.leaf_mask.reshape(-1) & (data[:, -1] > 0))
    slots = np.full(tree.child.size, EMPTY, np.int32)
    slots[held] = -2 - np.arange(len(held), dtype=np.int32)
    for rows, cells in zip(tree.levels[1:], tree.parent_cells[1:], strict=True):
        slots[cells] = rows
    return Field(tree.N, slots.reshape(tree.n, -1), data[held].astype(np.float32), tree.invradius, tree.offset, basis)


def _of_octree(octree: SparseVoxelOctree, basis: Basis) -> Field:
    leaves = octree.childless & (octree.sigma > 0)
    number = np.full(octree.n, EMPTY, np.int32)
    number[leaves] = -2 - np.arange(int(leaves.sum()), dtype=np.int32)
    inner = np.flatnonzero(~octree.childless)
    number[inner] = np.arange(len(inner))
    # The octree's octants are x + 2y + 4z, the marcher's cells [x][y][z].
    children = octree.node_children[inner].reshape(-1, 2, 2, 2).transpose(0, 3, 2, 1).reshape(-1, 8)
    slots = np.where(children == 0, np.int32(EMPTY), number[children])
    if not len(inner):
        slots = np.full((1, 8), number[0], np.int32)
    scale = 1 / (octree.voxel_size * (1 << octree.grid_level))
    values = octree.node_data[leaves].astype(np.float32)
    return Field(2, slots, values, scale, -octree.origin * scale, basis)
