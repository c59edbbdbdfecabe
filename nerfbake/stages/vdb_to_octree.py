"""VDB grids -> the sparse voxel octree they were made from."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.means import mean_edge, opacity
from nerfbake.kernels.morton import dilate
from nerfbake.kernels.pyramid import INNER, Level, children_table, merge_equal
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb import IndexGrid
from nerfbake.scene.vdb_topology import VdbTopology
from nerfbake.scene.volume import Volume
from nerfbake.stages._node_values import NodeValues

Ints = npt.NDArray[np.signedinteger[Any]]


def restore_octree(volume: Volume) -> SparseVoxelOctree:
    """The octree behind an index grid, or behind density and sh_0, sh_1, ...: its voxels bit for bit.

    Eight equal neighbours are one leaf and voxels of density 0 are no nodes, as build_octree has it, so its octrees
    come back with the same nodes. What inner nodes hold is not in the grids: it is made anew by build_octree's rule,
    with the voxel's width for the finest cell's, and is the same to the bit where the octree was baked at its tree's
    own resolution.

    Raises InvalidScene where the grids hold no octree: other programs' files, and those without coefficients.
    """
    if volume.frame is None:
        raise InvalidScene(Problem("the volume", "does not say which octree it was", "what `nerfbake vdb` writes"))
    frame, (topology, data) = volume.frame, _data(volume)
    held = np.flatnonzero(data[:, -1] != 0)  # half a float may be 0 where the voxel was thin
    coords = topology.coords[held].astype(np.int64)
    if len(coords) and (coords.min() < 0 or (coords.max(axis=0) >= frame.size).any()):
        size = "x".join(map(str, frame.size))
        raise InvalidScene(Problem("the volume", f"has voxels outside {size}", "voxels of its octree"))
    height = max(edge - 1 for edge in frame.size).bit_length()
    x, y, z = (dilate(coords[:, axis]) for axis in range(3))
    codes = x | y << 1 | z << 2
    order = np.argsort(codes)
    leaves = _Voxels(data, held[order], mean_edge(frame.voxel_size))
    levels = merge_equal(_levels(codes[order], height), leaves.same)
    return SparseVoxelOctree(
        size=frame.size,
        node_children=children_table(levels, all_slots=frame.layout == "full"),
        node_data=NodeValues(levels, leaves),
        data_format=frame.data_format,
        origin=frame.origin,
        voxel_size=frame.voxel_size,
        extra_data=frame.extra_data,
    )


def _data(volume: Volume) -> tuple[VdbTopology, npt.NDArray[Any]]:
    """The voxels, and (m, D) what they hold, density last."""
    first = volume.grids[0]
    if isinstance(first, IndexGrid):
        return first.topology, first.values
    density = volume.grid("density")
    coefficients = [volume.grid(f"sh_{k}") for k in range(len(volume.grids) - 1) if f"sh_{k}" in _names(volume)]
    if not coefficients:
        raise InvalidScene(Problem("the volume", f"has the grids {', '.join(_names(volume))}", "density,sh or index"))
    for grid in coefficients:
        same = grid.topology.same_as(density.topology)
        if not same or grid.values.shape[1] != 3 or grid.values.dtype != density.values.dtype:
            raise InvalidScene(Problem(f"grid {grid.name!r}", "differs from density in voxels or type", "one topology"))
    # (m, 3, B): all coefficients of red, then of green, then of blue.
    colours = np.stack([grid.values for grid in coefficients], axis=2).reshape(len(density.values), -1)
    return density.topology, np.concatenate([colours, density.values], axis=1)


def _names(volume: Volume) -> list[str]:
    return [grid.name for grid in volume.grids]


def _levels(codes: npt.NDArray[np.int64], height: int) -> list[Level]:
    """All levels above sorted Morton codes of voxels; voxel i is leaf i."""
    rows = [codes]
    for _ in range(height):
        above = rows[-1] >> 3
        rows.append(above[np.diff(above, prepend=-1) != 0])
    if not len(codes):
        return [Level(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.full(1, INNER, np.int32))]
    levels = [Level(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.full(1, INNER, np.int32))]
    for above, below in pairwise(rows[::-1]):
        parent = np.searchsorted(above, below >> 3).astype(np.int32)
        levels.append(Level(parent, (below & 7).astype(np.uint8), np.full(len(below), INNER, np.int32)))
    levels[-1].leaf[:] = np.arange(len(codes), dtype=np.int32)
    return levels


class _Voxels:
    """The octree's leaves by number: voxels in Morton order."""

    def __init__(self, data: npt.NDArray[Any], order: Ints, width: float) -> None:
        self._data, self._order, self._width = data, order, width
        self.data_dim, self.dtype = int(data.shape[1]), data.dtype

    def values(self, leaf: Ints) -> npt.NDArray[Any]:
        return self._data[self._order[leaf]]

    def opacity(self, leaf: Ints) -> npt.NDArray[np.float64]:
        return opacity(self._data[self._order[leaf], -1].astype(np.float32), self._width)

    def same(self, leaves: Ints) -> npt.NDArray[np.bool_]:
        """(m, 8) leaves -> (m,) bool: all eight hold exactly the same values."""
        sigma = self._data[self._order[leaves.reshape(-1)], -1].reshape(-1, 8)
        same: npt.NDArray[np.bool_] = np.all(sigma == sigma[:, :1], axis=1)
        some = np.flatnonzero(same)
        values = self.values(leaves[some].reshape(-1)).reshape(len(some), 8, self.data_dim)
        same[some] = (values == values[:, :1]).all(axis=(1, 2))
        return same
