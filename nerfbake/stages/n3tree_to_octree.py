"""PlenOctree (N3Tree) -> sparse voxel octree: TR-24-01, 3.2 and 3.3."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.lockstep import Cubes, Source, refine
from nerfbake.kernels.means import mean_of_runs, opacity
from nerfbake.kernels.overlap import parts_of
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.pyramid import INNER, Level, child_counts, children_table, drop_empty, merge_equal
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import MAX_SIZE, Layout, SparseVoxelOctree

Resample = Literal["mean", "nearest"]
Ints = npt.NDArray[np.signedinteger[Any]]

MAX_MEMORY = 4 << 30
_FLOAT16_MAX = 65504.0
_CHUNK = 1 << 13  # rows at a time: temporaries stay in the cache, and memory bounded


def build_octree(
    tree: N3Tree,
    *,
    resolution: int | tuple[int, int, int] | None = None,
    resample: Resample = "mean",
    layout: Layout = "full",
    dtype: Literal["float32", "float16"] = "float32",
    sigma_min: float | None = None,
    max_memory: int = MAX_MEMORY,
) -> SparseVoxelOctree:
    """The tree resampled to a grid of W x H x D voxels over its cube, as a breadth-first octree.

    resolution: one edge or (W, H, D), 1 to 4096; None is the tree's own finest. Where a voxel covers several
    leaves, `nearest` reads the one that holds its centre (on a boundary the upper one, as the report's program
    does), and `mean` takes the mean density of its volume and the opacity-weighted mean of the coefficients
    (kernels.means says how). Where it covers one, both copy that leaf's values exactly.

    Leaves whose density is 0 or less, or below sigma_min (1/world unit), are empty space; without a sigma_min a
    density below 0 is an error. Empty regions have no nodes; regions of exactly equal values are one leaf. An
    internal node holds the same mean of all the leaves below it, empty space included as density 0, so that any
    level can be shown. max_memory bounds the octree and its making, in bytes.

    Raises InvalidScene if the tree is broken, holds values that no renderer can use, or stands in NDC; MemoryLimit.
    """
    size = _grid_size(tree, resolution)
    if resample not in ("mean", "nearest"):
        raise InvalidScene(Problem("resample", f"is {resample!r}", "mean, nearest"))
    if sigma_min is not None and not sigma_min >= 0:
        raise InvalidScene(Problem("sigma_min", f"is {sigma_min:g}", "0 or more"))
    _require_usable(tree, sigma_min)
    source = _source(tree, sigma_min or 0.0)
    node_bytes = tree.data_dim * np.dtype(dtype).itemsize + 8 * 4 + 16
    levels, mixed = refine(source, size, centres=resample == "nearest", node_bytes=node_bytes, max_memory=max_memory)
    leaves = _Leaves(tree, source, _finest_width(tree), np.dtype(dtype))
    if (levels[-1].leaf >= source.link.size).any():
        leaves.add_means(mixed, size)
    levels = merge_equal(drop_empty(levels), leaves.same)
    data = _node_values(levels, leaves)
    return SparseVoxelOctree(
        size=size,
        node_children=children_table(levels, all_slots=layout == "full"),
        node_data=data,
        data_format=tree.data_format,
        origin=-tree.offset / tree.invradius,
        voxel_size=1 / (tree.invradius * size),
        extra_data=tree.extra_data,
    )


# -- what may be read ------------------------------------------------------------------------------------------
def _grid_size(tree: N3Tree, resolution: int | tuple[int, int, int] | None) -> tuple[int, int, int]:
    if resolution is None:
        if tree.resolution > MAX_SIZE:
            raise InvalidScene(
                Problem("the tree", f"has {tree.resolution} cells an axis", f"a --resolution of 1 to {MAX_SIZE}")
            )
        resolution = tree.resolution
    w, h, d = (resolution,) * 3 if isinstance(resolution, int) else resolution
    if not all(1 <= edge <= MAX_SIZE for edge in (w, h, d)):
        raise InvalidScene(Problem("resolution", f"is {w}x{h}x{d}", f"1 to {MAX_SIZE} voxels an axis"))
    return w, h, d


def _require_usable(tree: N3Tree, sigma_min: float | None) -> None:
    if tree.ndc:
        found = "marks a forward-facing scene (NDC), whose cube is no box of the world"
        raise InvalidScene(Problem("its _poses_bounds.npy", found, "scenes in world coordinates"))
    for problem in tree.value_problems(negative_is_empty=sigma_min is not None):
        raise InvalidScene(problem)


def _finest_width(tree: N3Tree) -> float:
    """The width of a cell of the deepest level in world units: the geometric mean of its three edges."""
    return float(np.prod(np.abs(tree.invradius)) ** (-1 / 3) / tree.resolution)


def _source(tree: N3Tree, sigma_min: float) -> Source:
    """The tree for descents: links only to nodes that hold something, densities only where a leaf does."""
    sigma = tree.data[..., -1].reshape(-1).astype(np.float32)
    density = np.where(tree.leaf_mask.reshape(-1) & (sigma > 0) & (sigma >= sigma_min), sigma, np.float32(0))
    holds = np.any(density.reshape(tree.n, -1) > 0, axis=1)
    link = np.zeros(density.size, np.int32)
    for rows, cells in zip(tree.levels[:0:-1], tree.parent_cells[:0:-1], strict=True):
        filled = holds[rows]
        link[cells[filled]] = rows[filled]
        holds[cells[filled] // tree.N**3] = True
    return Source(tree.N, tree.N ** np.arange(1, len(tree.levels) + 1), link, density)


# -- what they hold --------------------------------------------------------------------------------------------
class _Leaves:
    """The values of the octree's leaves by number, in the octree's dtype.

    0 .. n C          a leaf of the tree: its flat cell
    n C .. n C + n    a whole node of the tree: the mean of what is below it
    from n C + n      a voxel that covers several leaves: the mean of its parts
    """

    def __init__(self, tree: N3Tree, source: Source, length: float, dtype: np.dtype[Any]) -> None:
        self._tree, self._source, self._length, self.dtype = tree, source, length, dtype
        self._cells = tree.data.reshape(-1, tree.data_dim)
        self.data_dim = tree.data_dim
        self._means = np.empty((0, tree.data_dim), np.float32)
        self._mean_opacity = np.empty(0)

    def values(self, leaf: Ints) -> npt.NDArray[Any]:
        """(m, D) in the octree's dtype. Raises InvalidScene where that dtype cannot hold a value."""
        return self._rounded(self._exact(leaf))

    def sigma(self, leaf: Ints) -> npt.NDArray[Any]:
        return self._rounded(self._pick(leaf, self._source.density, self._means[:, -1]))

    def opacity(self, leaf: Ints) -> npt.NDArray[np.float64]:
        """What each weighs in a mean."""
        own = opacity(self._pick(leaf, self._source.density, self._means[:, -1]), self._length)
        mean = leaf >= len(self._cells)
        own[mean] = self._mean_opacity[leaf[mean] - len(self._cells)]
        return own

    def same(self, leaves: Ints) -> npt.NDArray[np.bool_]:
        """(m, 8) leaves -> (m,) bool: all eight hold exactly the same values."""
        sigma = self.sigma(leaves.reshape(-1)).reshape(-1, 8)
        same: npt.NDArray[np.bool_] = np.all(sigma == sigma[:, :1], axis=1)
        for part in np.array_split(np.flatnonzero(same), 1 + len(same) // _CHUNK):
            values = self.values(leaves[part].reshape(-1)).reshape(len(part), 8, self.data_dim)
            same[part] = (values == values[:, :1]).all(axis=(1, 2))
        return same

    def add_means(self, voxels: Cubes, size: tuple[int, int, int]) -> None:
        """Works out the means of the tree's nodes, from the deepest up, and of voxels made of several parts."""
        tree, C = self._tree, self._tree.N**3
        self._means = np.zeros((tree.n + len(voxels.row), self.data_dim), np.float32)
        self._mean_opacity = np.zeros(len(self._means))
        for rows in reversed(tree.levels):
            for part in _chunks(rows):
                cells = (part[:, None] * C + np.arange(C)).reshape(-1)
                held = (self._source.density[cells] > 0) | (self._source.link[cells] > 0)
                link = self._source.link[cells[held]]
                parts = np.where(link > 0, len(self._cells) + link, cells[held])
                counts = held.reshape(-1, C).sum(axis=1)
                self._set_means(part, parts, np.broadcast_to(1 / C, len(parts)), counts)
        for start in range(0, len(voxels.row), _CHUNK):
            chunk = Cubes(*(array[start : start + _CHUNK] for array in voxels))
            covered = parts_of(self._source, chunk, size)
            counts = np.bincount(covered.voxel, minlength=len(chunk.row))
            where = tree.n + start + np.arange(len(chunk.row))
            self._set_means(where, covered.part, covered.volume, counts)

    def _set_means(self, where: Ints, parts: Ints, volume: npt.NDArray[np.float64], counts: Ints) -> None:
        def rows_at(rows: Ints) -> npt.NDArray[Any]:
            return self._exact(parts[rows])

        mean = mean_of_runs(rows_at, self.opacity(parts), volume, counts, self.data_dim)
        self._means[where], self._mean_opacity[where] = mean

    def _exact(self, leaf: Ints) -> npt.NDArray[Any]:
        mean = leaf >= len(self._cells)
        if not mean.any():
            return self._cells[leaf]
        if mean.all():
            return self._means[leaf - len(self._cells)]
        values = self._cells[np.where(mean, 0, leaf)].astype(np.float32)
        values[mean] = self._means[leaf[mean] - len(self._cells)]
        return values

    def _pick(self, leaf: Ints, cells: npt.NDArray[Any], means: npt.NDArray[Any]) -> npt.NDArray[Any]:
        picked = cells[np.minimum(leaf, len(cells) - 1)]
        mean = leaf >= len(cells)
        picked[mean] = means[leaf[mean] - len(cells)]
        return picked

    def _rounded(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        if self.dtype == np.float16 and values.dtype != np.float16 and values.size:
            largest = float(np.abs(values).max())
            if largest > _FLOAT16_MAX:
                raise InvalidScene(Problem("the tree", f"holds {largest:g}", f"up to {_FLOAT16_MAX:g} for float16"))
        return values.astype(self.dtype, copy=False)


def _node_values(levels: list[Level], leaves: _Leaves) -> npt.NDArray[Any]:
    """(n, D): leaves as they are, inner nodes the mean of their children, from the last level up."""
    sizes = [len(level.leaf) for level in levels]
    data = np.zeros((sum(sizes), leaves.data_dim), leaves.dtype)
    weight = np.zeros(0)
    end = len(data)
    for height, level in reversed(list(enumerate(levels))):
        start = end - sizes[height]
        level_weight = np.zeros(sizes[height])
        own = np.flatnonzero(level.leaf != INNER)
        level_weight[own] = leaves.opacity(level.leaf[own])

        def copy(begin: int, end: int, own: Ints = own, level: Level = level, start: int = start) -> None:
            data[start + own[begin:end]] = leaves.values(level.leaf[own[begin:end]])

        over_chunks(copy, len(own), _CHUNK)
        inner = np.flatnonzero(level.leaf == INNER)
        if height + 1 < len(levels) and len(inner):
            counts = child_counts(levels, height)[inner]
            below = data[end : end + sizes[height + 1]]
            mean = mean_of_runs(below.__getitem__, weight, np.broadcast_to(1 / 8, len(below)), counts, leaves.data_dim)
            data[start + inner], level_weight[inner] = mean
        weight, end = level_weight, start
    return data


def _chunks(array: Ints) -> list[Ints]:
    return [array[start : start + _CHUNK] for start in range(0, len(array), _CHUNK)]
