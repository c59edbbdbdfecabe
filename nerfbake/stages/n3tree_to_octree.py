"""PlenOctree (N3Tree) -> sparse voxel octree, whose leaves are copies or means of the tree's leaves.

Source: TR-24-01 (docs/sources.md), 3.2 and 3.3.
"""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Indices
from nerfbake.kernels.octree.lockstep import NodeBudget, OctreeCubes, SourceTree, refine
from nerfbake.kernels.octree.node_values import NodeRows, parts_of, to_float32
from nerfbake.kernels.octree.pyramid import children_table, drop_empty, mean_edge, mean_of_runs, merge_equal, opacity
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree
from nerfbake.stages.half import cast_values

_CHUNK = 1 << 13  # rows at a time, so that temporaries stay in the cache and memory is bounded


class LeafValues:
    """The values of the octree's leaves by number, in the octree's dtype. C = N^3.

    0 .. n C          a leaf of the tree: its flat cell
    n C .. n C + n    a whole node of the tree: the mean of the leaves below it
    from n C + n      a voxel that covers several leaves: the mean of its parts
    """

    def __init__(self, tree: N3Tree, density: npt.NDArray[np.float32], length: float, dtype: np.dtype[Any]) -> None:
        self._tree, self._density, self._length, self.dtype = tree, density, length, dtype
        self._cells = tree.data.reshape(-1, tree.data_dim)
        self.data_dim = tree.data_dim
        self._means = np.empty((0, tree.data_dim), np.float32)
        self._mean_opacity = np.empty(0)

    @property
    def held(self) -> int:
        """Bytes in memory in addition to the tree's own."""
        return self._density.nbytes + self._means.nbytes + self._mean_opacity.nbytes

    def values(self, leaf: Indices) -> npt.NDArray[Any]:
        """Return values (m, D) in the octree's dtype. Raises InvalidScene if a value is too large for it."""
        return self._rounded(self._exact(leaf))

    def hold(self, leaf: Indices) -> npt.NDArray[np.bool_]:
        """Return (m,) bool: leaves with a density above 0 in the octree's dtype, which may round a low density to 0."""
        return self._sigma(leaf) > 0

    def _sigma(self, leaf: Indices) -> npt.NDArray[Any]:
        return self._rounded(self._pick(leaf, self._density, self._means[:, -1]))

    def opacity(self, leaf: Indices) -> npt.NDArray[np.float64]:
        """Return the weight of each leaf in a mean: its opacity."""
        own = opacity(self._pick(leaf, self._density, self._means[:, -1]), self._length)
        mean = np.flatnonzero(leaf >= len(self._cells))
        own[mean] = self._mean_opacity[leaf[mean] - len(self._cells)]
        return own

    def same(self, leaves: Indices) -> npt.NDArray[np.bool_]:
        """Return (m,) bool for leaves (m, 8): all eight have exactly the same values."""
        sigma = self._sigma(leaves.reshape(-1)).reshape(-1, 8)
        same: npt.NDArray[np.bool_] = np.all(sigma == sigma[:, :1], axis=1)
        for part in np.array_split(np.flatnonzero(same), 1 + len(same) // _CHUNK):
            values = self.values(leaves[part].reshape(-1)).reshape(len(part), 8, self.data_dim)
            same[part] = (values == values[:, :1]).all(axis=(1, 2))
        return same

    def add_means(self, source: SourceTree, voxels: OctreeCubes, size: tuple[int, int, int]) -> None:
        """Compute the means of the tree's nodes, from the deepest level up, and of voxels with several parts."""
        tree, C = self._tree, self._tree.N**3
        self._means = np.zeros((tree.n + len(voxels.row), self.data_dim), np.float32)
        self._mean_opacity = np.zeros(len(self._means))
        for depth in range(len(tree.levels) - 1, -1, -1):
            if tree.N**depth < max(size):
                break  # nodes larger than a voxel are not part of any voxel
            for part in _chunks(tree.levels[depth]):
                cells = (part[:, None] * C + np.arange(C)).reshape(-1)
                held = (source.density[cells] > 0) | (source.link[cells] > 0)
                link = source.link[cells[held]]
                parts = np.where(link > 0, len(self._cells) + link, cells[held])
                counts = held.reshape(-1, C).sum(axis=1)
                self._set_means(part, parts, np.broadcast_to(1 / C, len(parts)), counts)
        for start in range(0, len(voxels.row), _CHUNK):
            chunk = OctreeCubes(*(array[start : start + _CHUNK] for array in voxels))
            covered = parts_of(source, chunk, size)
            counts = np.bincount(covered.voxel, minlength=len(chunk.row))
            filled = np.flatnonzero(counts)  # the other voxels cover empty cells only
            self._set_means(tree.n + start + filled, covered.part, covered.volume, counts[filled])

    def _set_means(self, where: Indices, parts: Indices, volume: npt.NDArray[np.float64], counts: Indices) -> None:
        def rows_at(begin: int, end: int) -> npt.NDArray[Any]:
            return to_float32(self._exact(parts[begin:end]))

        means = np.empty((len(counts), self.data_dim), np.float32)
        self._mean_opacity[where] = mean_of_runs(rows_at, self.opacity(parts), volume, counts, means)
        self._means[where] = means

    def _exact(self, leaf: Indices) -> npt.NDArray[Any]:
        mean = leaf >= len(self._cells)
        if not mean.any():
            return _rows(self._cells, leaf)
        if mean.all():
            return self._means.take(leaf - len(self._cells), axis=0)
        values = np.empty((len(leaf), self.data_dim), np.float32)
        values[~mean] = _rows(self._cells, leaf[~mean])
        values[mean] = self._means.take(leaf[mean] - len(self._cells), axis=0)
        return values

    def _pick(self, leaf: Indices, cells: npt.NDArray[Any], means: npt.NDArray[Any]) -> npt.NDArray[Any]:
        mean = np.flatnonzero(leaf >= len(cells))
        picked = cells.take(leaf, mode="clip")
        picked[mean] = means[leaf[mean] - len(cells)]
        return picked

    def _rounded(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if self.dtype == np.float32:
            return to_float32(values)
        return cast_values(values, self.dtype, what="the tree", asked="float16")


def _rows(values: npt.NDArray[Any], rows: Indices) -> npt.NDArray[Any]:
    """Return some rows. If the array is not aligned, as in a memory-mapped file, take() would copy all of it first."""
    return values.take(rows, axis=0) if values.flags.aligned else values[rows]


def _chunks(array: Indices) -> list[Indices]:
    return [array[start : start + _CHUNK] for start in range(0, len(array), _CHUNK)]


_PER_CELL = 8  # bytes per cell, for its density and link
Resample = Literal["mean", "nearest"]


def build_octree(
    tree: N3Tree,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    resample: Resample = "mean",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
) -> SparseVoxelOctree:
    """Resample a PlenOctree to a grid of W x H x D voxels over its cube, as a breadth-first octree.

    resolution: one edge or (W, H, D), 1 to 4096; None: the tree's finest resolution. If a voxel covers several leaves,
    `nearest` copies the leaf that contains its centre (on a boundary the upper one, like the report's program), and
    `mean` computes the mean density of its volume and the opacity-weighted mean of the coefficients (see
    kernels.octree.pyramid). If a voxel covers one leaf, both copy that leaf's values exactly.

    Leaves with a density of 0 or less, or below sigma_min (1/world unit), are empty space; without sigma_min, a
    density below 0 is an error. Empty regions have no nodes, and regions of exactly equal values are merged to one
    leaf. An inner node stores the same mean of all leaves below it, with empty space as density 0, so that every level
    can be rendered. The float32 values of leaves are not stored, but copied from the tree on demand.

    Raises InvalidScene if the tree is broken, contains values that no renderer can use, or is in NDC; MemoryLimit.

    >>> from nerfbake import build_octree, sample_n3tree
    >>> octree = build_octree(sample_n3tree(resolution=16), resolution=8)
    >>> octree.size, octree.grid_level, octree.data_format
    ((8, 8, 8), 3, 'SH9')
    """
    size = _grid_size(tree, resolution)
    if resample not in ("mean", "nearest"):
        raise InvalidScene(Problem("resample", f"is {resample!r}", "mean, nearest"))
    if sigma_min is not None and not sigma_min >= 0:
        raise InvalidScene(Problem("sigma_min", f"is {sigma_min:g}", "0 or more"))
    _require_usable(tree, sigma_min)
    with memory.lent("the tree's densities and links", _PER_CELL * tree.n * tree.N**3):
        source = _source(tree, sigma_min or 0.0)
        room = _room(tree.data_dim, layout, dtype)
        levels, mixed = refine(source, size, centres=resample == "nearest", room=room)
        leaves = LeafValues(tree, source.density, _finest_width(tree), np.dtype(dtype))
        if (levels[-1].leaf >= source.link.size).any():
            leaves.add_means(source, mixed, size)
    del source  # its links are no longer needed
    levels = merge_equal(drop_empty(levels, leaves.hold), leaves.same)
    values = NodeRows(levels, leaves)
    octree = SparseVoxelOctree(
        size=size,
        node_children=children_table(levels, all_slots=layout == "full"),
        # float16 is computed now, because a value may be too large for it; float32 is computed on demand.
        node_data=values if dtype == "float32" else np.asarray(values),
        data_format=tree.data_format,
        origin=-tree.offset / tree.invradius,
        voxel_size=1 / (tree.invradius * size),
        extra_data=tree.extra_data,
    )
    return memory.kept(octree)


def _room(data_dim: int, layout: Layout, dtype: str) -> NodeBudget:
    """Return the bytes per node: 24 while nodes are created, their child slots, and the stored values.

    For float32 only means are stored, since leaves are copied from the tree; float16 stores a row for every node.
    """
    mean, slots = 4 * data_dim + 8, 8 * 4
    node = 24 + (slots if layout == "full" else 0) + (0 if dtype == "float32" else 2 * data_dim)
    return NodeBudget(node=node, inner=mean + (0 if layout == "full" else slots))


# -- checks and the source tree --------------------------------------------------------------------------------
def _grid_size(tree: N3Tree, resolution: int | tuple[int, int, int] | None) -> tuple[int, int, int]:
    if resolution is None:
        if tree.resolution > MAX_SIZE:
            raise InvalidScene(
                Problem("the tree", f"has {tree.resolution} cells an axis", f"a `resolution` of 1 to {MAX_SIZE}")
            )
        resolution = tree.resolution
    w, h, d = (resolution,) * 3 if isinstance(resolution, int) else resolution
    if not all(1 <= edge <= MAX_SIZE for edge in (w, h, d)):
        raise InvalidScene(Problem("resolution", f"is {w}x{h}x{d}", f"1 to {MAX_SIZE} voxels an axis"))
    return w, h, d


def _require_usable(tree: N3Tree, sigma_min: float | None) -> None:
    if tree.ndc:
        found = "marks a forward-facing scene (NDC), whose cube is not a box in the world"
        raise InvalidScene(Problem("its _poses_bounds.npy", found, "scenes in world coordinates"))
    for problem in tree.value_problems(negative_is_empty=sigma_min is not None):
        raise InvalidScene(problem)


def _finest_width(tree: N3Tree) -> float:
    """Return the width of a cell of the deepest level in world units: the geometric mean of its three edges."""
    # Same order of operations as in build_octree_from_volume(), so that both compute the same means to the bit.
    return mean_edge(1 / (np.abs(tree.invradius) * tree.resolution))


def _source(tree: N3Tree, sigma_min: float) -> SourceTree:
    """Return the tree for descents, with links only to nodes that are not empty, and densities only in leaves."""
    sigma = tree.sigma.reshape(-1)
    density = np.where(tree.leaf_mask.reshape(-1) & (sigma > 0) & (sigma >= sigma_min), sigma, np.float32(0))
    holds = np.any(density.reshape(tree.n, -1) > 0, axis=1)
    link = np.zeros(density.size, np.int32)
    for rows, cells in zip(tree.levels[:0:-1], tree.parent_cells[:0:-1], strict=True):
        filled = holds[rows]
        link[cells[filled]] = rows[filled]
        holds[cells[filled] // tree.N**3] = True
    return SourceTree(tree.N, tree.N ** np.arange(1, len(tree.levels) + 1), link, density)
