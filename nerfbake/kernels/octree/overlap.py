"""Which parts of an N^3 tree a voxel covers, and how much of the voxel each part fills."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.octree.lockstep import OctreeCubes, Source, spans


class Parts(NamedTuple):
    """Parts of voxels, voxel after voxel. part < n C is a leaf's flat cell, above it n C + row is a whole node."""

    voxel: Ints
    part: Ints
    volume: npt.NDArray[np.float64]  # share of the voxel, 0..1; what is left of 1 is empty


def parts_of(source: Source, voxels: OctreeCubes, size: tuple[int, int, int]) -> Parts:
    """The leaves, and the nodes as large as possible, that lie in each voxel; parts of no density are left out.

    voxels: single voxels with a source node that contains each. Nodes on a voxel's border are cut open down to
    their leaves, which count by the volume inside.
    """
    N, cells_per_node = source.N, source.N**3
    span = spans(voxels, 0, size, centres=False)
    K_of_depth = np.concatenate([[1], source.cells])
    voxel, row, depth = np.arange(len(voxels.row)), voxels.row, voxels.depth
    place = [a * K_of_depth[depth] // (2 * edge) for (a, _), edge in zip(span, size, strict=True)]
    found: list[Parts] = []
    while len(voxel):
        # Nodes that the voxel contains count whole.
        fill = [
            _fill(a[voxel], b[voxel], at, K_of_depth[depth], edge)
            for (a, b), at, edge in zip(span, place, size, strict=True)
        ]
        whole = fill[0].whole & fill[1].whole & fill[2].whole
        share = fill[0].share * fill[1].share * fill[2].share
        found.append(Parts(voxel[whole], source.link.size + row[whole], share[whole]))
        cut = ~whole
        voxel, row, depth, place = voxel[cut], row[cut], depth[cut], [at[cut] for at in place]
        # The others fall apart into their cells.
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
    share: npt.NDArray[np.float64]  # of the span that the cell fills
    whole: npt.NDArray[np.bool_]  # the cell lies in the span


def _fill(a: Ints, b: Ints, at: Ints, K: Ints, edge: int) -> _Fill:
    """How cell `at` of K along an axis meets the span from a to b (in 1 / 2 edge); all in units of 1 / (2 edge K)."""
    low, high = at * 2 * edge, (at + 1) * 2 * edge
    inside = np.minimum(b * K, high) - np.maximum(a * K, low)
    return _Fill(np.maximum(inside, 0) / ((b - a) * K), (low >= a * K) & (high <= b * K))
