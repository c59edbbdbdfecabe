"""Descend an octree over a voxel grid and an N^3 tree over the same cube together.

All comparisons use integers: coordinate x of a grid of W voxels is at x / W of the cube, cell i of a level of K cells
starts at i / K, and x / W < i / K is x K < i W. So there is no rounding for any grid size, aligned or not.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.octree.pyramid import INNER, Level

# Octant o = x + 2y + 4z: the steps along each axis.
_STEPS = tuple(np.arange(8) >> axis & 1 for axis in range(3))
_MAX_NUMBER = 2**31 - 1  # of a leaf: with 32 bits, levels take half the memory of 64
_CHUNK = 1 << 13  # cubes split at a time: temporaries stay in the cache, and memory stays bounded


class SourceTree(NamedTuple):
    """The tree to read from, prepared for descents. C = N^3 cells per node; a flat cell is row * C + cell."""

    N: int
    cells: Ints  # (levels,) cells along an axis at each depth: N, N^2, ...
    link: npt.NDArray[np.int32]  # (n C,) row of the child that is not empty; 0 = leaf or empty
    density: npt.NDArray[np.float32]  # (n C,) density of leaves; 0 if empty or if there is a child


class OctreeCubes(NamedTuple):
    """Octree nodes of one level: their positions, and the deepest source node that contains each."""

    x: Ints
    y: Ints
    z: Ints
    row: Ints
    depth: Ints

    def take(self, which: npt.NDArray[np.bool_]) -> OctreeCubes:
        return OctreeCubes(*(array[which] for array in self))


def octants_of(parents: OctreeCubes) -> OctreeCubes:
    """The eight octants of every cube, parent by parent."""
    place = (((q[:, None] << 1) + step).reshape(-1) for q, step in zip(parents[:3], _STEPS, strict=True))
    x, y, z = place
    return OctreeCubes(x, y, z, np.repeat(parents.row, 8), np.repeat(parents.depth, 8))


def spans(cubes: OctreeCubes, shift: int, size: tuple[int, int, int], *, centres: bool) -> list[tuple[Ints, Ints]]:
    """For each axis, the interval a .. b of the grid that each cube of 2^shift voxels covers, in units of 1 / 2W.

    With `centres`, from its first to its last voxel centre; otherwise from edge to edge. Clipped to the end of the
    grid.
    """
    found = []
    for q, edge in zip(cubes[:3], size, strict=True):
        a = q << (shift + 1)
        b = np.minimum(a + (2 << shift), 2 * edge)
        found.append((a + 1, b - 1) if centres else (a, b))
    return found


def descend_source(
    source: SourceTree, cubes: OctreeCubes, shift: int, size: tuple[int, int, int], *, centres: bool
) -> tuple[Ints, OctreeCubes]:
    """Follow the source tree down as long as one of its cells contains the whole cube.

    Returns (m,) the flat leaf cell that contains each cube (density 0: empty) or INNER, and the cubes with the deepest
    source node that contains each. The extent of a cube is that of spans().
    """
    N, cells_per_node = source.N, source.N**3
    span = spans(cubes, shift, size, centres=centres)
    exclusive = 0 if centres else 1
    leaf = np.full(len(cubes.row), INNER, np.int64)
    row, depth = cubes.row.copy(), cubes.depth.copy()
    active = np.arange(len(row))
    while len(active):
        K = source.cells[depth[active]]
        cell, same = np.zeros(len(active), np.int64), np.ones(len(active), bool)
        for (a, b), edge in zip(span, size, strict=True):
            first = a[active] * K // (2 * edge)
            same &= first == (b[active] * K - exclusive) // (2 * edge)
            cell = cell * N + first % N
        active, cell = active[same], cell[same] + row[active[same]] * cells_per_node
        below = source.link[cell]
        at_leaf = below == 0
        leaf[active[at_leaf]] = cell[at_leaf]
        active, below = active[~at_leaf], below[~at_leaf]
        row[active] = below
        depth[active] += 1
    return leaf, cubes._replace(row=row, depth=depth)


class NodeBudget(NamedTuple):
    """The bytes that the nodes of the octree need."""

    node: int  # for each node
    inner: int  # in addition for each node that is not within one leaf of the source: its mean is stored

    def require(self, nodes: int, inner: int, size: tuple[int, int, int]) -> None:
        """Raise MemoryLimit if these nodes do not fit."""
        memory.require(f"an octree of {'x'.join(map(str, size))} voxels", nodes * self.node + inner * self.inner)


def refine(
    source: SourceTree, size: tuple[int, int, int], *, centres: bool, room: NodeBudget
) -> tuple[list[Level], OctreeCubes]:
    """Split the cube of the grid, from the root down, wherever it is neither empty nor within one leaf.

    Returns the levels, whose leaves are flat cells of the source, or n C + row for a voxel that is a whole source node;
    and the voxels made of several parts, the k-th of which has the number n C + n + k. All parts of such a voxel may be
    empty; this is visible only in the parts. With `centres`, a voxel covers what its centre hits. Raises MemoryLimit as
    soon as the nodes need too much memory.
    """
    if _halves_alike(source, size, centres=centres):
        return _follow(source, size, room), OctreeCubes(*(np.zeros(0, np.int64) for _ in range(5)))
    shift = max(edge - 1 for edge in size).bit_length()
    root = OctreeCubes(*(np.zeros(1, np.int64) for _ in range(5)))
    level, inner = _keep(source, root, root.row, np.zeros(1, np.uint8), shift, size, centres=centres)
    if not len(level.leaf):
        # Everything is empty: the root stays, as an inner node without children.
        return [Level(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.full(1, INNER, np.int32))], inner
    levels, nodes, split = [level], 1, 1
    while len(inner.row) and shift:
        shift -= 1
        found = []
        at = np.flatnonzero(level.leaf == INNER)
        for start in range(0, len(at), _CHUNK):
            some = slice(start, start + _CHUNK)
            cubes = octants_of(OctreeCubes(*(array[some] for array in inner)))
            parent, octant = np.repeat(at[some], 8), np.tile(np.arange(8, dtype=np.uint8), len(at[some]))
            found.append(_keep(source, cubes, parent, octant, shift, size, centres=centres))
            nodes, split = nodes + len(found[-1][0].leaf), split + len(found[-1][1].row)
            room.require(nodes, split, size)
        level = Level(*(np.concatenate(arrays) for arrays in zip(*(piece for piece, _ in found), strict=True)))
        inner = OctreeCubes(*(np.concatenate(arrays) for arrays in zip(*(piece for _, piece in found), strict=True)))
        levels.append(level)
    # A cube that is still not within one leaf is a single voxel: a whole node of the source, or parts of several.
    exact = np.ones(len(inner.row), bool)
    K = np.concatenate([[1], source.cells])[inner.depth]
    for (a, b), edge in zip(spans(inner, 0, size, centres=centres), size, strict=True):
        exact &= (b - a) * K == 2 * edge
    number = source.link.size + inner.row
    number[~exact] = source.link.size + source.link.size // source.N**3 + np.arange(np.count_nonzero(~exact))
    _number(level, number, source)
    return levels, inner.take(~exact)


def _halves_alike(source: SourceTree, size: tuple[int, int, int], *, centres: bool) -> bool:
    """Return whether the cubes of the octree are the cells of the source tree, all the way down to voxels."""
    aligned = source.N == 2 and len(set(size)) == 1 and size[0] & (size[0] - 1) == 0
    return aligned and (not centres or size[0] >= source.cells[-1])  # a larger voxel's centre is inside one cell


def _follow(source: SourceTree, size: tuple[int, int, int], room: NodeBudget) -> list[Level]:
    """The result of refine() if _halves_alike(), in a fifth of the time: copy the source's nodes level by level."""
    octant = np.arange(8)
    cell_of_octant = (octant & 1) << 2 | octant & 2 | octant >> 2  # octant x + 2y + 4z is cell 4x + 2y + z of a node
    level, row = Level(np.zeros(1, np.int32), np.zeros(1, np.uint8), np.full(1, INNER, np.int32)), np.zeros(1, np.int32)
    levels, nodes, split = [level], 1, 1
    while len(levels) < size[0].bit_length() and len(row):
        cell = (row.astype(np.int64)[:, None] * 8 + cell_of_octant).reshape(-1)
        link = source.link.take(cell)
        held = np.flatnonzero((link > 0) | (source.density.take(cell) > 0))
        nodes, split = nodes + len(held), split + int(np.count_nonzero(link > 0))
        room.require(nodes, split, size)
        link, parent = link.take(held), np.flatnonzero(level.leaf == INNER).astype(np.int32).take(held >> 3)
        leaf = np.where(link > 0, np.int32(INNER), cell.take(held).astype(np.int32))
        level = Level(parent, (held & 7).astype(np.uint8), leaf)
        levels.append(level)
        row = link[link > 0]
    _number(level, source.link.size + row.astype(np.int64), source)
    return levels


def _number(level: Level, number: Ints, source: SourceTree) -> None:
    """Number the voxels that are not within one leaf."""
    if max(source.link.size, number.max(initial=0)) > _MAX_NUMBER:
        raise InvalidScene(
            Problem("the tree", f"has {source.link.size:,} cells", f"at most {_MAX_NUMBER:,} cells and voxels")
        )
    level.leaf[level.leaf == INNER] = number


def _keep(
    source: SourceTree,
    cubes: OctreeCubes,
    parent: Ints,
    octant: npt.NDArray[np.uint8],
    shift: int,
    size: tuple[int, int, int],
    *,
    centres: bool,
) -> tuple[Level, OctreeCubes]:
    """Return the cubes in the grid that are not empty, and those of them that must be split."""
    within = np.ones(len(parent), bool)
    for q, edge in zip(cubes[:3], size, strict=True):
        within &= q << shift < edge
    if not within.all():
        cubes, parent, octant = cubes.take(within), parent[within], octant[within]
    leaf, cubes = descend_source(source, cubes, shift, size, centres=centres)
    held = (leaf == INNER) | (source.density[leaf] > 0)
    # A leaf must not extend beyond the grid: its values would fill space outside of it.
    for q, edge in zip(cubes[:3], size, strict=True):
        leaf[(q + 1) << shift > edge] = INNER
    level = Level(parent[held].astype(np.int32), octant[held], leaf[held].astype(np.int32))
    return level, cubes.take(held & (leaf == INNER))
