"""Any scene as the marcher wants it: one tree of cells, the values of what is not empty, and where it stands."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.march.cells import EMPTY, Cells, cells_of, rows_at
from nerfbake.kernels.maths.affine import inverse, placed, turned
from nerfbake.scene.basis import Basis, parse_basis
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.volume import Volume

Points = npt.NDArray[np.float64]
Radiance = N3Tree | SparseVoxelOctree | Volume  # the scenes that pictures can be made of


class Field(NamedTuple):
    """A radiance field over a tree of cells.

    values (leaves, 3 B + 1) float32, density per world unit last; place (3, 4): cells of the last level = place @
    (world, 1); box (2, 3): in cells, around all leaves, or the whole tree where there are none.
    """

    cells: Cells
    values: npt.NDArray[np.float32]
    place: Points
    box: Points
    basis: Basis

    @property
    def axes(self) -> Points:
        """(3, 3) the field's own axes in the world, a row each, unit vectors; its SH are in these."""
        rows = self.place[:, :3] / np.linalg.norm(self.place[:, :3], axis=1, keepdims=True)
        return np.asarray(rows, np.float64)

    def world(self, points: Points) -> Points:
        """(m, 3) in cells -> the world."""
        return turned(points - self.place[:, 3], inverse(self.place[:, :3]))

    def sample(self, points: Points) -> npt.NDArray[np.float32]:
        """(m, 3) in the world -> (m, 3 B + 1) of the leaf around each point, zeros where there is none."""
        rows = rows_at(self.cells, placed(points, self.place))
        found = np.zeros((len(points), 3 * self.basis.size + 1), np.float32)
        found[rows >= 0] = self.values[rows[rows >= 0]]
        return found

    def leaf_centres(self, most: int) -> Points:
        """(m, 3) world centres of the leaves, evenly thinned out to `most`."""
        centres = [corners + width / 2 for corners, width in leaves_of(self.cells)] or [np.empty((0, 3))]
        found = np.concatenate(centres)
        return self.world(found[np.linspace(0, len(found) - 1, most).astype(int)] if len(found) > most else found)


def leaves_of(cells: Cells) -> Iterator[tuple[Points, float]]:
    """The lowest corners (m, 3) of each level's leaves, and their width, in cells of the last level."""
    nodes, corner = np.zeros(1, np.int64), np.zeros((1, 3))
    for first, bits, width in zip(cells.first, cells.bits, cells.width, strict=True):
        steps = np.stack(np.unravel_index(np.arange(1 << 3 * bits), (1 << bits,) * 3), axis=1)
        slots = cells.slots[first + (nodes[:, None] << 3 * bits) + np.arange(1 << 3 * bits)]
        node, cell = np.nonzero(slots < EMPTY)
        if len(node):
            yield corner[node] + steps[cell] * width, float(width)
        node, cell = np.nonzero(slots >= 0)
        nodes, corner = slots[node, cell].astype(np.int64), corner[node] + steps[cell] * width


def box_of(cells: Cells, limit: npt.ArrayLike = np.inf) -> Points:
    """(2, 3) around all leaves, up to `limit`; around the whole tree where there are none."""
    low, high = np.full(3, float(cells.edge)), np.zeros(3)
    for corners, width in leaves_of(cells):
        low = np.minimum(low, corners.min(axis=0))
        high = np.maximum(high, corners.max(axis=0) + width)
    high = np.minimum(high, limit)
    return np.stack([low, high]) if (low < high).all() else np.array([[0.0] * 3, [cells.edge] * 3])


@lru_cache(maxsize=2)
def field_of(scene: Radiance) -> Field:
    """The scene made ready; kept for the next picture. Raises InvalidScene for what cannot be shown."""
    for problem in scene.structure_problems() or scene.value_problems():
        raise InvalidScene(problem)
    if isinstance(scene, N3Tree):
        return _of_n3tree(scene, shown_basis(scene.data_format))
    if isinstance(scene, SparseVoxelOctree):
        return _of_octree(scene)
    # Imported here: it imports this module's Field.
    from nerfbake.stages._volume_field import field_of_volume

    return field_of_volume(scene)


def shown_basis(data_format: str) -> Basis:
    """Raises InvalidScene for a basis that cannot be shown."""
    if not data_format:
        raise InvalidScene(Problem("data_format", "is not known", "SHk or RGBA"))
    basis = parse_basis(data_format)
    if basis.kind not in ("SH", "RGBA"):
        raise InvalidScene(Problem("data_format", f"is {data_format}", "SHk or RGBA can be rendered"))
    return basis


def _of_n3tree(tree: N3Tree, basis: Basis) -> Field:
    data = tree.data.reshape(-1, tree.data_dim)
    held = np.flatnonzero(tree.leaf_mask.reshape(-1) & (data[:, -1] > 0))
    slots = np.full(tree.child.size, EMPTY, np.int32)
    slots[held] = -2 - np.arange(len(held), dtype=np.int32)
    for rows, children in zip(tree.levels[1:], tree.parent_cells[1:], strict=True):
        slots[children] = rows
    N, bits = tree.N, (tree.N - 1).bit_length()
    wide = 1 << bits
    if wide > N:
        own, slots = slots.reshape(tree.n, N, N, N), np.full(tree.n * wide**3, EMPTY, np.int32)
        slots.reshape(tree.n, wide, wide, wide)[:, :N, :N, :N] = own
    cells = cells_of(slots, [bits] * len(tree.levels), radix=N if wide > N else 0)
    place = cells.edge * np.column_stack([np.diag(tree.invradius), tree.offset])
    return Field(cells, data[held].astype(np.float32), place, box_of(cells), basis)


def _of_octree(octree: SparseVoxelOctree) -> Field:
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
    box = box_of(cells, np.array(octree.size) * (cells.edge >> octree.grid_level))
    values = octree.node_data[leaves].astype(np.float32)
    if alone:
        values = np.concatenate([np.zeros((len(values), 3), np.float32), values], axis=1)
    return Field(cells, values, place, box, basis)
