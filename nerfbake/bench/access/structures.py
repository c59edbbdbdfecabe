"""Trilinear reads in structures for comparison with VDB: a dense array, Plenoxels' dense array of pointers, an octree.

nerfbake uses these structures only in this benchmark, on one thread. Points lie in the grid or up to half a voxel
outside. The dense arrays are padded with an empty voxel on all sides, so that reads need no bounds check. Sources:
Plenoxels (Fridovich-Keil et al., 2022), its links; TR-24-01, 3.2 (docs/sources.md).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Points, Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.vdb.accessor import interpolate
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.vdb_topology import VdbTopology

Edges = tuple[int, int, int]  # voxels along x, y and z
Links = npt.NDArray[np.int32]
ONE = np.uint64(1)


class Structure(NamedTuple):
    """read(*arrays, points, out) fills out (n, C). points (n, 3) are in voxels, with centres at whole numbers."""

    read: Any
    arrays: tuple[Any, ...]

    @property
    def nbytes(self) -> int:
        return _bytes(self.arrays)


def _bytes(part: Any) -> int:
    return sum(map(_bytes, part)) if isinstance(part, tuple) else part.nbytes if isinstance(part, np.ndarray) else 0


def dense(size: Edges, topology: VdbTopology, values: Singles) -> Structure:
    """Build an x-major array of all voxels from the values (m, C) of the active ones."""
    w, h, d = _padded(size)
    table = np.zeros((w * h * d, values.shape[1]), np.float32)
    table[_flat(size, topology)] = values
    return Structure(read_dense, ((w, h, d), table))


def pointers(size: Edges, topology: VdbTopology, values: Singles) -> Structure:
    """Build an array with a row number for each voxel, int32 as in Plenoxels; the last row is the empty one."""
    w, h, d = _padded(size)
    links = np.full(w * h * d, topology.m, np.int32)
    links[_flat(size, topology)] = np.arange(topology.m, dtype=np.int32)
    table = np.concatenate([values, np.zeros((1, values.shape[1]), np.float32)])
    return Structure(read_pointers, ((w, h, d), links, table))


def octree(tree: SparseVoxelOctree, channels: int) -> Structure:
    """Build eight links for each inner node (c, 8): the row of an inner node, or -1 - row of a leaf.

    Absent children link to the last row of the table, which is empty. The table has only the last channels.
    """
    n, inner = tree.n, np.flatnonzero(~tree.childless)
    leaves = tree.childless & (tree.sigma > 0)
    goal = np.where(leaves, -1 - np.arange(n), -1 - n).astype(np.int32)
    goal[inner] = np.arange(len(inner))
    children = tree.node_children[inner]
    links = np.where(children == 0, np.int32(-1 - n), goal[children]) if len(inner) else np.full((1, 8), goal[0])
    table = np.zeros((n + 1, channels), np.float32)
    table[:-1][leaves] = tree.node_data[leaves, -channels:]
    return Structure(read_octree, (tree.size, links, max(tree.grid_level, 1), table))


def _padded(size: Edges) -> Edges:
    return size[0] + 2, size[1] + 2, size[2] + 2


def _flat(size: Edges, topology: VdbTopology) -> npt.NDArray[np.int64]:
    _, h, d = _padded(size)
    x, y, z = topology.coords.astype(np.int64).T + 1
    return np.asarray((x * h + y) * d + z)


@compiled()
def read_dense(padded: Edges, table: Singles, points: Points, out: Singles) -> None:
    """Read rows directly; padded is the size of the array."""
    for i in range(len(points)):
        x, y, z = int(np.floor(points[i, 0])), int(np.floor(points[i, 1])), int(np.floor(points[i, 2]))
        o, p, q, r = _edges(padded, x, y, z)
        _mix(table, o, o + ONE, p, p + ONE, q, q + ONE, r, r + ONE, points, x, y, z, out, i)


@compiled()
def read_pointers(padded: Edges, links: Links, table: Singles, points: Points, out: Singles) -> None:
    """Read rows through the links."""
    for i in range(len(points)):
        x, y, z = int(np.floor(points[i, 0])), int(np.floor(points[i, 1])), int(np.floor(points[i, 2]))
        o, p, q, r = _edges(padded, x, y, z)
        a, b, c, d = links[o], links[o + ONE], links[p], links[p + ONE]
        e, f, g, h = links[q], links[q + ONE], links[r], links[r + ONE]
        _mix(table, a, b, c, d, e, f, g, h, points, x, y, z, out, i)


@compiled()
def read_octree(size: Edges, links: Links, levels: int, table: Singles, points: Points, out: Singles) -> None:
    """Descend from the root for each of the eight voxels."""
    top = len(table) - 1
    for i in range(len(points)):
        x, y, z = int(np.floor(points[i, 0])), int(np.floor(points[i, 1])), int(np.floor(points[i, 2]))
        a, b = _leaf(size, links, levels, top, x, y, z), _leaf(size, links, levels, top, x, y, z + 1)
        c, d = _leaf(size, links, levels, top, x, y + 1, z), _leaf(size, links, levels, top, x, y + 1, z + 1)
        e, f = _leaf(size, links, levels, top, x + 1, y, z), _leaf(size, links, levels, top, x + 1, y, z + 1)
        g, h = _leaf(size, links, levels, top, x + 1, y + 1, z), _leaf(size, links, levels, top, x + 1, y + 1, z + 1)
        _mix(table, a, b, c, d, e, f, g, h, points, x, y, z, out, i)


@compiled(inline=True)
def _edges(padded: Edges, x: int, y: int, z: int) -> tuple[np.uint64, np.uint64, np.uint64, np.uint64]:
    """Return the offsets of the four pairs of voxels along z; unsigned, which avoids tests for negative indices."""
    _, h, d = padded
    first = ((x + 1) * h + y + 1) * d + z + 1
    return np.uint64(first), np.uint64(first + d), np.uint64(first + h * d), np.uint64(first + h * d + d)


@compiled()
def _leaf(size: Edges, links: Links, levels: int, nothing: int, x: int, y: int, z: int) -> int:
    """Return the row of the leaf that contains a voxel, or the empty row."""
    w, h, d = size
    if (x < 0) | (y < 0) | (z < 0) | (x >= w) | (y >= h) | (z >= d):
        return nothing
    node, shift = 0, levels
    while node >= 0:
        shift -= 1
        node = int(links[node, x >> shift & 1 | (y >> shift & 1) << 1 | (z >> shift & 1) << 2])
    return -1 - node


@compiled(inline=True)
def _mix(
    table: Singles,
    r0: Any, r1: Any, r2: Any, r3: Any, r4: Any, r5: Any, r6: Any, r7: Any,
    points: Points,
    x: int, y: int, z: int,
    out: Singles,
    i: int,
) -> None:  # fmt: skip
    f0, f1, f2 = np.float32(points[i, 0] - x), np.float32(points[i, 1] - y), np.float32(points[i, 2] - z)
    if out.shape[1] == 1:
        flat = table.reshape(-1)
        a, b, c, d = flat[r0], flat[r1], flat[r2], flat[r3]
        e, f, g, h = flat[r4], flat[r5], flat[r6], flat[r7]
        out[i, 0] = interpolate(a, b, c, d, e, f, g, h, f0, f1, f2)
    else:
        for k in range(out.shape[1]):
            a, b, c, d = table[r0, k], table[r1, k], table[r2, k], table[r3, k]
            e, f, g, h = table[r4, k], table[r5, k], table[r6, k], table[r7, k]
            out[i, k] = interpolate(a, b, c, d, e, f, g, h, f0, f1, f2)
