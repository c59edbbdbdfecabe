"""What the leaves of an octree made from an N3Tree hold: copies of its leaves, and means."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Indices
from nerfbake.kernels.octree.halves import widened
from nerfbake.kernels.octree.lockstep import OctreeCubes, Source
from nerfbake.kernels.octree.means import mean_of_runs, opacity
from nerfbake.kernels.octree.overlap import parts_of
from nerfbake.scene.n3tree import N3Tree
from nerfbake.stages._half import rounded

_CHUNK = 1 << 13  # rows at a time: temporaries stay in the cache, and memory bounded


class LeafValues:
    """The values of the octree's leaves by number, in the octree's dtype.

    0 .. n C          a leaf of the tree: its flat cell
    n C .. n C + n    a whole node of the tree: the mean of what is below it
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
        """Bytes beside the tree's own."""
        return self._density.nbytes + self._means.nbytes + self._mean_opacity.nbytes

    def values(self, leaf: Indices) -> npt.NDArray[Any]:
        """(m, D) in the octree's dtype. Raises InvalidScene where that dtype cannot hold a value."""
        return self._rounded(self._exact(leaf))

    def hold(self, leaf: Indices) -> npt.NDArray[np.bool_]:
        """(m,) bool: these are not empty in the octree's dtype, in which a thin one may be 0."""
        return self._sigma(leaf) > 0

    def _sigma(self, leaf: Indices) -> npt.NDArray[Any]:
        return self._rounded(self._pick(leaf, self._density, self._means[:, -1]))

    def opacity(self, leaf: Indices) -> npt.NDArray[np.float64]:
        """What each weighs in a mean."""
        own = opacity(self._pick(leaf, self._density, self._means[:, -1]), self._length)
        mean = np.flatnonzero(leaf >= len(self._cells))
        own[mean] = self._mean_opacity[leaf[mean] - len(self._cells)]
        return own

    def same(self, leaves: Indices) -> npt.NDArray[np.bool_]:
        """(m, 8) leaves -> (m,) bool: all eight hold exactly the same values."""
        sigma = self._sigma(leaves.reshape(-1)).reshape(-1, 8)
        same: npt.NDArray[np.bool_] = np.all(sigma == sigma[:, :1], axis=1)
        for part in np.array_split(np.flatnonzero(same), 1 + len(same) // _CHUNK):
            values = self.values(leaves[part].reshape(-1)).reshape(len(part), 8, self.data_dim)
            same[part] = (values == values[:, :1]).all(axis=(1, 2))
        return same

    def add_means(self, source: Source, voxels: OctreeCubes, size: tuple[int, int, int]) -> None:
        """Works out the means of the tree's nodes, from the deepest up, and of voxels made of several parts."""
        tree, C = self._tree, self._tree.N**3
        self._means = np.zeros((tree.n + len(voxels.row), self.data_dim), np.float32)
        self._mean_opacity = np.zeros(len(self._means))
        for depth in range(len(tree.levels) - 1, -1, -1):
            if tree.N**depth < max(size):
                break  # nodes larger than a voxel are no part of any
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
            filled = np.flatnonzero(counts)  # the rest of what lies across cells covers only empty ones
            self._set_means(tree.n + start + filled, covered.part, covered.volume, counts[filled])

    def _set_means(self, where: Indices, parts: Indices, volume: npt.NDArray[np.float64], counts: Indices) -> None:
        def rows_at(begin: int, end: int) -> npt.NDArray[Any]:
            return widened(self._exact(parts[begin:end]))

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
            return widened(values)
        return rounded(values, self.dtype, what="the tree", asked="float16")


def _rows(values: npt.NDArray[Any], rows: Indices) -> npt.NDArray[Any]:
    """Some rows; of an array that is not aligned, as a file's may be, take() would first copy the whole."""
    return values.take(rows, axis=0) if values.flags.aligned else values[rows]


def _chunks(array: Indices) -> list[Indices]:
    return [array[start : start + _CHUNK] for start in range(0, len(array), _CHUNK)]
