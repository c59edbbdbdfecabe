"""Find the cells that contain points, by descents of whole chunks of points at once; and Morton codes.

Chunks of 2^15 points keep every temporary in the second-level cache: 3 to 4 times faster than one pass over a million
points, and memory stays bounded.

A Morton code is the path from an octree's root to a voxel, three bits per level:

    x = ..dcba   ->   dilate(x) = ..00d00c00b00a        code = dilate(x) | dilate(y) << 1 | dilate(z) << 2
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.parallel import over_chunks


def dilate(x: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Spread the bits of each number (21 at most) with two zeros between them.

    x                     0 .. 2^21 - 1
    x | x << 32, masked   in groups of 16 and fewer bits
    ... 16, 8, 4, 2       in groups of 8, 4, 2 and 1
    """
    x = (x | x << 32) & 0x001F00000000FFFF
    x = (x | x << 16) & 0x001F0000FF0000FF
    x = (x | x << 8) & 0x100F00F00F00F00F
    x = (x | x << 4) & 0x10C30C30C30C30C3
    return (x | x << 2) & 0x1249249249249249


_CHUNK = 1 << 15
SNAP = 1e-12  # in tree units: a point this close below a boundary counts as on it


def as_points(points: npt.ArrayLike) -> Points:
    """Return the points as (..., 3) float64. Raises InvalidScene for another shape."""
    array = np.asarray(points, np.float64)
    if array.ndim < 1 or array.shape[-1] != 3:
        raise InvalidScene(Problem("points", f"have shape {array.shape}", "(..., 3)"))
    return array


def in_chunks(read: Callable[[Points], npt.NDArray[np.float32]], points: Points, width: int) -> npt.NDArray[np.float32]:
    """Apply read() to (..., 3) points, one chunk at a time -> (..., width)."""
    flat = points.reshape(-1, 3)
    out = np.empty((len(flat), width), np.float32)

    def work(begin: int, end: int) -> None:
        out[begin:end] = read(flat[begin:end])

    over_chunks(work, len(flat), _CHUNK)
    return out.reshape(*points.shape[:-1], width)


def n3tree_cells(child: npt.NDArray[np.int32], N: int, levels: int, points: Points) -> npt.NDArray[np.int64]:
    """The flat leaf cell (row * N^3 + cell) that contains each point of [0, 1)^3; -1 outside.

    child (n, N^3): relative offsets of a valid tree with this number of levels; points (m, 3).
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
    children: npt.NDArray[np.int32],
    childless: npt.NDArray[np.bool_],
    levels: int,
    codes: npt.NDArray[np.int64],
) -> npt.NDArray[np.int64]:
    """The leaf that contains each voxel, given by its Morton code; -1 for empty space.

    children (c, 8) with 0 for "no child"; childless (n,) bool; the cube has 2^levels voxels along an edge.
    """
    node = np.full(len(codes), -1, np.int64)
    active, at = np.arange(len(codes)), np.zeros(len(codes), np.int64)
    flat = children.reshape(-1)
    for shift in range(3 * levels - 3, -4, -3):
        leaf = childless[at]
        node[active[leaf]] = at[leaf]
        if shift < 0 or leaf.all():
            break
        # Voxels at a leaf have no children to descend to: they are removed with those that hit empty space.
        slot = at * 8 + (codes >> shift & 7)
        slot[leaf] = 0
        below = flat.take(slot, mode="clip")
        below[leaf] = 0
        on = np.flatnonzero(below)
        active, at, codes = active[on], below[on].astype(np.int64), codes[on]
    return node


def octree_values(
    children: npt.NDArray[np.int32],
    childless: npt.NDArray[np.bool_],
    data: npt.NDArray[Any],
    levels: int,
    size: tuple[int, int, int],
    points: Points,
    corners: int,
) -> npt.NDArray[np.float32]:
    """(m, D) values at points (m, 3) in voxels.

    corners = 1: the value of the voxel that contains the point. corners = 2: the trilinear interpolation of the 2 x 2 x
    2 voxels whose centres surround the point. Empty space and space outside `size` count as zeros.
    """
    shifted = points if corners == 1 else points - 0.5
    low = np.floor(shifted)
    low[~((low > -corners) & (low < max(size)))] = -corners  # points that are far away, and NaN
    steps = []
    for axis, edge in enumerate(size):
        voxel = low[:, axis].astype(np.int64)
        far = shifted[:, axis] - voxel
        weights = [np.ones(len(points))] if corners == 1 else [1 - far, far]
        steps.append([_step(voxel + k, edge, weight) for k, weight in enumerate(weights)])
    out = np.zeros((len(points), data.shape[1]), np.float32)
    for x, y, z in product(*steps):
        weight = x.weight * y.weight * z.weight
        hit = np.flatnonzero(weight > 0)
        node = octree_nodes(children, childless, levels, x.code[hit] | y.code[hit] << 1 | z.code[hit] << 2)
        hit, node = hit[node >= 0], node[node >= 0]
        values = data[node].astype(np.float32, copy=False)
        if corners == 1:
            out[hit] = values
        else:
            out[hit] += values * weight[hit, None].astype(np.float32)
    return out


class _Step(NamedTuple):
    """One of the voxels around a point, along one axis."""

    code: npt.NDArray[np.int64]  # dilated, for a Morton code
    weight: Points


def _step(voxel: npt.NDArray[np.int64], edge: int, weight: Points) -> _Step:
    """Dilate the voxel's coordinate. Outside the grid its weight is 0."""
    inside = (voxel >= 0) & (voxel < edge)
    return _Step(dilate(np.where(inside, voxel, 0)), np.where(inside, weight, 0))
