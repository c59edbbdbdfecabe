"""What the nodes of an octree hold: copies of leaves, and means of what is below a node."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Indices
from nerfbake.kernels.octree.means import mean_of_runs, opacity
from nerfbake.kernels.octree.pyramid import INNER, Level, child_counts
from nerfbake.kernels.parallel import over_chunks

_CHUNK = 1 << 12  # rows at a time: temporaries stay in the second-level cache


class Leaves(Protocol):
    """What an octree's leaves hold, by number."""

    data_dim: int
    dtype: np.dtype[Any]

    @property
    def held(self) -> int:
        """Bytes that they hold themselves."""

    def values(self, leaf: Indices) -> npt.NDArray[Any]:
        """(m, D) in dtype."""

    def opacity(self, leaf: Indices) -> Floats:
        """What each weighs in a mean."""


class MadeRows:
    """(n, D) rows that are made when they are asked for: rows[begin:end] gives some, np.asarray(rows) all of them."""

    shape: tuple[int, int]
    dtype: np.dtype[Any]

    @property
    def nbytes(self) -> int:
        """What they all take."""
        return self.shape[0] * self.shape[1] * self.dtype.itemsize

    def __getitem__(self, rows: slice) -> npt.NDArray[Any]:
        raise NotImplementedError

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        out = np.empty(self.shape, self.dtype)

        def make(begin: int, end: int) -> None:
            out[begin:end] = self[begin:end]

        over_chunks(make, len(out), _CHUNK)
        return out if dtype is None else out.astype(dtype, copy=False)


class NodeRows(MadeRows):
    """(n, D) rows in breadth-first order, of which only the means are kept: leaves are copied when they are asked for.

    So an octree can be written whose values do not fit beside those they come from.
    """

    def __init__(self, levels: list[Level], leaves: Leaves) -> None:
        self._leaves = leaves
        self._leaf = np.concatenate([level.leaf for level in levels])
        self._inner = np.flatnonzero(self._leaf == INNER)
        self.shape, self.dtype = (len(self._leaf), leaves.data_dim), leaves.dtype
        self._means = np.zeros((len(self._inner), leaves.data_dim), leaves.dtype)
        weight, end = np.zeros(0), len(self._leaf)
        for height in range(len(levels) - 1, -1, -1):
            weight = self._add_level(levels, height, end, weight)
            end -= len(levels[height].leaf)

    @property
    def held(self) -> int:
        """What is in memory before any of them is asked for: the means, and what says which leaf each row is."""
        return self._means.nbytes + self._leaf.nbytes + self._inner.nbytes + self._leaves.held

    def __getitem__(self, rows: slice) -> npt.NDArray[Any]:
        begin, end, _ = rows.indices(len(self._leaf))
        leaf = self._leaf[begin:end]
        first, last = np.searchsorted(self._inner, (begin, end))
        if first == last:
            return self._leaves.values(leaf)
        out = np.empty((end - begin, self.shape[1]), self.dtype)
        out[self._inner[first:last] - begin] = self._means[first:last]
        own = np.flatnonzero(leaf != INNER)
        out[own] = self._leaves.values(leaf[own])
        return out

    def take(self, rows: Indices, axis: int) -> npt.NDArray[Any]:
        """(m, D) of these nodes, leaves all of them."""
        return self._leaves.values(self._leaf[rows])

    def _add_level(self, levels: list[Level], height: int, end: int, weight_below: Floats) -> Floats:
        """Works out the means of a level whose last row is before `end`; (m,) what its nodes weigh in the next."""
        leaf = levels[height].leaf
        weight = np.zeros(len(leaf))
        own, inner = np.flatnonzero(leaf != INNER), np.flatnonzero(leaf == INNER)
        weight[own] = self._leaves.opacity(leaf[own])
        if not len(inner) or height + 1 == len(levels):
            return weight

        def below(begin: int, stop: int) -> npt.NDArray[Any]:
            return self[end + begin : end + stop]

        volume = np.broadcast_to(1 / 8, len(weight_below))
        first = np.searchsorted(self._inner, end - len(leaf))
        means = self._means[first : first + len(inner)]
        weight[inner] = mean_of_runs(below, weight_below, volume, child_counts(levels, height)[inner], means)
        # A mean of something never rounds to nothing: where a level is cut, it is a leaf.
        means[means[:, -1] == 0, -1] = np.nextafter(self.dtype.type(0), self.dtype.type(1))
        return weight


class LeafRows:
    """Leaves by number: rows of values (m, D), density last, and what they weigh in cells of this width."""

    def __init__(self, data: npt.NDArray[Any], width: float) -> None:
        self._data, self._width = data, width
        self.data_dim, self.dtype = int(data.shape[1]), data.dtype

    @property
    def held(self) -> int:
        return int(self._data.nbytes)

    def values(self, leaf: Indices) -> npt.NDArray[Any]:
        return self._data[leaf]

    def opacity(self, leaf: Indices) -> Floats:
        return opacity(self._data[leaf, -1].astype(np.float32), self._width)

    def same(self, leaves: Indices) -> npt.NDArray[np.bool_]:
        """(m, 8) leaves -> (m,) bool: all eight hold exactly the same values."""
        sigma = self._data[leaves.reshape(-1), -1].reshape(-1, 8)
        same: npt.NDArray[np.bool_] = np.all(sigma == sigma[:, :1], axis=1)
        some = np.flatnonzero(same)
        values = self.values(leaves[some].reshape(-1)).reshape(len(some), 8, self.data_dim)
        same[some] = (values == values[:, :1]).all(axis=(1, 2))
        return same
