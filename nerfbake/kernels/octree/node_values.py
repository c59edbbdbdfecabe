"""Values of octree nodes: copies of leaves, and means of the nodes below.

to_float32() converts float16 to float32, three times as fast as a cast:

    half           s eeeee ffffffffff                  value  2^(e - 15)  (1 + f / 2^10)
    shifted by 13  s 000eeeee ffffffffff000...         reads  2^(e - 127) (1 + f / 2^10)

The rest is one multiplication by 2^112. It is exact for small halves, too, whose exponent is 0.

parts_of() returns the parts of an N^3 tree that a voxel covers, and how much of the voxel each part fills.
"""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Indices, Ints
from nerfbake.kernels.octree.lockstep import OctreeCubes, SourceTree, spans
from nerfbake.kernels.octree.pyramid import INNER, Level, child_counts, mean_of_runs, opacity
from nerfbake.kernels.parallel import over_chunks

_SCALE = np.float32(2.0**112)
_NO_EXPONENT = ~np.int32(0x70000000)  # clears the copies of the sign in the additional exponent bits of float32


def to_float32(values: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Return finite float16 values as float32; float32 values unchanged."""
    if values.dtype != np.float16:
        return values
    bits = values.view(np.int16).astype(np.int32)
    bits <<= 13
    bits &= _NO_EXPONENT
    wide = bits.view(np.float32)
    wide *= _SCALE
    return wide


_CHUNK = 1 << 12  # rows at a time: temporaries stay in the second-level cache


class Leaves(Protocol):
    """The values of an octree's leaves, by number."""

    data_dim: int
    dtype: np.dtype[Any]

    @property
    def held(self) -> int:
        """Bytes in memory."""

    def values(self, leaf: Indices) -> npt.NDArray[Any]:
        """(m, D) in dtype."""

    def opacity(self, leaf: Indices) -> Floats:
        """The weight of each leaf in a mean."""


class ComputedRows:
    """(n, D) rows that are computed on access: rows[begin:end] returns some, np.asarray(rows) all of them."""

    shape: tuple[int, int]
    dtype: np.dtype[Any]

    @property
    def nbytes(self) -> int:
        """Bytes of all rows."""
        return self.shape[0] * self.shape[1] * self.dtype.itemsize

    def __getitem__(self, rows: slice) -> npt.NDArray[Any]:
        raise NotImplementedError

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> npt.NDArray[Any]:
        out = np.empty(self.shape, self.dtype)

        def make(begin: int, end: int) -> None:
            out[begin:end] = self[begin:end]

        over_chunks(make, len(out), _CHUNK)
        return out if dtype is None else out.astype(dtype, copy=False)


class NodeRows(ComputedRows):
    """(n, D) rows in breadth-first order. Only the means are stored; leaves are copied on access.

    So an octree can be written even if its values do not fit into memory beside their source.
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
        """Bytes in memory before any row is accessed: the means, and the leaf number of each row."""
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
        """(m, D) rows of these nodes, all of which must be leaves."""
        return self._leaves.values(self._leaf[rows])

    def _add_level(self, levels: list[Level], height: int, end: int, weight_below: Floats) -> Floats:
        """Compute the means of the level whose last row is before `end`.

        Returns (m,) the weights of its nodes in the next mean.
        """
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
        # The mean of a node that is not empty never rounds to 0: it is a leaf if the levels below are cut off.
        means[means[:, -1] == 0, -1] = np.nextafter(self.dtype.type(0), self.dtype.type(1))
        return weight


class LeafRows:
    """Leaves by number: rows of values (m, D), density last. Their weight is the opacity of a cell of this width."""

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
        """(m, 8) leaves -> (m,) bool: whether all eight have exactly the same values."""
        sigma = self._data[leaves.reshape(-1), -1].reshape(-1, 8)
        same: npt.NDArray[np.bool_] = np.all(sigma == sigma[:, :1], axis=1)
        some = np.flatnonzero(same)
        values = self.values(leaves[some].reshape(-1)).reshape(len(some), 8, self.data_dim)
        same[some] = (values == values[:, :1]).all(axis=(1, 2))
        return same


class Parts(NamedTuple):
    """Parts of voxels, voxel by voxel. A part below n C is the flat cell of a leaf; n C + row is a whole node."""

    voxel: Ints
    part: Ints
    volume: npt.NDArray[np.float64]  # share of the voxel, 0..1; the rest of the voxel is empty


def parts_of(source: SourceTree, voxels: OctreeCubes, size: tuple[int, int, int]) -> Parts:
    """Return the leaves, and the largest possible nodes, inside each voxel. Parts without density are left out.

    voxels: single voxels with a source node that contains each. Nodes on the border of a voxel are opened down to their
    leaves, which count by the volume inside.
    """
    N, cells_per_node = source.N, source.N**3
    span = spans(voxels, 0, size, centres=False)
    K_of_depth = np.concatenate([[1], source.cells])
    voxel, row, depth = np.arange(len(voxels.row)), voxels.row, voxels.depth
    place = [a * K_of_depth[depth] // (2 * edge) for (a, _), edge in zip(span, size, strict=True)]
    found: list[Parts] = []
    while len(voxel):
        # Nodes that the voxel contains count as a whole.
        fill = [
            _fill(a[voxel], b[voxel], at, K_of_depth[depth], edge)
            for (a, b), at, edge in zip(span, place, size, strict=True)
        ]
        whole = fill[0].whole & fill[1].whole & fill[2].whole
        share = fill[0].share * fill[1].share * fill[2].share
        found.append(Parts(voxel[whole], source.link.size + row[whole], share[whole]))
        cut = ~whole
        voxel, row, depth, place = voxel[cut], row[cut], depth[cut], [at[cut] for at in place]
        # Split the others into their cells.
        K = source.cells[depth]
        steps = np.arange(N)
        shares = []
        for (a, b), at, edge in zip(span, place, size, strict=True):
            shares.append(_fill(a[voxel][:, None], b[voxel][:, None], at[:, None] * N + steps, K[:, None], edge).share)
        volume = (shares[0][:, :, None, None] * shares[1][:, None, :, None] * shares[2][:, None, None, :]).reshape(-1)
        cell = (row[:, None] * cells_per_node + np.arange(cells_per_node)).reshape(-1)
        leaf = np.flatnonzero((volume > 0) & (source.density[cell] > 0))
        found.append(Parts(voxel[leaf // cells_per_node], cell[leaf], volume[leaf]))
        inner = np.flatnonzero((volume > 0) & (source.link[cell] > 0))
        parent, octant = inner // cells_per_node, inner % cells_per_node
        digits = (octant // (N * N), octant // N % N, octant % N)
        place = [at[parent] * N + digit for at, digit in zip(place, digits, strict=True)]
        voxel, row, depth = voxel[parent], source.link[cell[inner]].astype(np.int64), depth[parent] + 1
    together = Parts(*(np.concatenate(arrays) for arrays in zip(*found, strict=True)))
    order = np.argsort(together.voxel, kind="stable")
    return Parts(together.voxel[order], together.part[order], together.volume[order])


class _Fill(NamedTuple):
    share: npt.NDArray[np.float64]  # of the span that the cell fills, 0..1
    whole: npt.NDArray[np.bool_]  # the whole cell is in the span


def _fill(a: Ints, b: Ints, at: Ints, K: Ints, edge: int) -> _Fill:
    """The overlap of cell `at` of K along an axis with the span from a to b (in 1 / 2 edge).

    All comparisons are in units of 1 / (2 edge K).
    """
    low, high = at * 2 * edge, (at + 1) * 2 * edge
    inside = np.minimum(b * K, high) - np.maximum(a * K, low)
    return _Fill(np.maximum(inside, 0) / ((b - a) * K), (low >= a * K) & (high <= b * K))
