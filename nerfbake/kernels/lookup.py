"""From points to the cells that hold them: descents of whole chunks of points at once.

Chunks of 2^15 points keep every temporary in the second-level cache: 3 to 4 times faster than one pass over a
million points, and memory stays bounded.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem

CHUNK = 1 << 15
SNAP = 1e-12  # in tree units: a point this close below a boundary counts as on it

Points = npt.NDArray[np.float64]


def as_points(points: npt.ArrayLike) -> Points:
    """(..., 3) float64. Raises InvalidScene for another shape."""
    array = np.asarray(points, np.float64)
    if array.ndim < 1 or array.shape[-1] != 3:
        raise InvalidScene(Problem("points", f"have shape {array.shape}", "(..., 3)"))
    return array


def in_chunks(read: Callable[[Points], npt.NDArray[np.float32]], points: Points, width: int) -> npt.NDArray[np.float32]:
    """read() over (..., 3) points a chunk at a time -> (..., width)."""
    flat = points.reshape(-1, 3)
    out = np.empty((len(flat), width), np.float32)
    for start in range(0, len(flat), CHUNK):
        out[start : start + CHUNK] = read(flat[start : start + CHUNK])
    return out.reshape(*points.shape[:-1], width)


def n3tree_cells(child: npt.NDArray[np.int32], N: int, levels: int, points: Points) -> npt.NDArray[np.int64]:
    """The flat leaf cell (row * N^3 + cell) that holds each point of [0, 1)^3; -1 outside.

    child is (n, N^3), relative offsets of a sound tree with that many levels; points (m, 3).
    """
    snapped = points + SNAP
    inside = ((snapped >= 0) & (snapped < 1)).all(axis=1)
    found = np.full(len(points), -1, np.int64)
    active = np.flatnonzero(inside)
    index = [np.floor(snapped[active, axis] * float(N**levels)).astype(np.int64) for axis in range(3)]
    row = np.zeros(len(active), np.int64)
    for depth in range(levels):
        width = N ** (levels - 1 - depth)
        x, y, z = ((i // width) % N for i in index)
        cell = row * N**3 + (x * N + y) * N + z
        offset = child.reshape(-1)[cell]
        leaf = offset == 0
        found[active[leaf]] = cell[leaf]
        inner = ~leaf
        active, row = active[inner], row[inner] + offset[inner]
        index = [i[inner] for i in index]
    return found


def octree_nodes(
    children: npt.NDArray[np.int32], childless: npt.NDArray[np.bool_], levels: int, voxels: npt.NDArray[Any]
) -> npt.NDArray[np.int64]:
    """The leaf that holds each voxel (m, 3) of the cube of 2^levels voxels an edge; -1 for empty space.

    children is (c, 8) with 0 for "no child"; childless is (n,) bool. A voxel outside the cube is empty.
    """
    # One unsigned comparison sees both ends: -1 wraps to the largest number.
    inside = (voxels.view(np.uint64) < np.uint64(1 << levels)).all(axis=1)
    node = np.full(len(voxels), -1, np.int64)
    active = np.flatnonzero(inside)
    x, y, z = (voxels[active, axis] for axis in range(3))
    at = np.zeros(len(active), np.int64)
    flat = children.reshape(-1)
    for shift in range(levels - 1, -2, -1):
        leaf = childless[at]
        if leaf.any():
            node[active[leaf]] = at[leaf]
            inner = ~leaf
            active, at, x, y, z = active[inner], at[inner], x[inner], y[inner], z[inner]
        if shift < 0 or not len(active):
            break
        octant = (x >> shift & 1) | (y >> shift & 1) << 1 | (z >> shift & 1) << 2
        at = flat[at * 8 + octant].astype(np.int64)
        filled = at != 0
        active, at, x, y, z = active[filled], at[filled], x[filled], y[filled], z[filled]
    return node
