"""An octree's leaves as bricks of 8 x 8 x 8 voxels: which voxels are filled, and by which leaf.

Bricks are nodes of the octree, or parts of larger leaves. In breadth-first order the nodes below a run of bricks are a
run of each level, and the slot of a voxel in its brick follows from the octants on the way down:

    octant  z y x, one bit each     slot  x x x y y y z z z: children set the bits of 4, their children of 2, then of 1

So nothing is sorted here. If you need sorted voxels, sort only the bricks.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints, Words
from nerfbake.kernels.parallel import over_chunks

_CHUNK = 512  # bricks at a time: their slots stay in the second-level cache
_NOBODY = -1
_ROWS = 1 << 15  # nodes at a time
_FEW = 1 << 22  # number of bricks up to which a brick and 9 bits of slot fit into 32 bits
NodeNumbers = npt.NDArray[np.int32]


class Bricks(NamedTuple):
    """Bricks of 8^3 voxels.

    low (p, 3): the lowest voxel; mask (p, 8): the filled voxels, slot x << 6 | y << 3 | z; node (m,): the leaf that
    fills each voxel, brick by brick, slots rising.
    """

    low: Ints
    mask: Words
    node: NodeNumbers


class _Part(NamedTuple):
    """Filled leaves of one level: their numbers, their start (brick << 9 | slot, rising), their edge."""

    node: NodeNumbers
    cell: npt.NDArray[Any]  # int32 or int64
    edge: int


def bricks_of(
    children: npt.NDArray[np.int32],
    level_sizes: list[int],
    filled: npt.NDArray[np.bool_],
    size: tuple[int, int, int],
) -> Bricks:
    """The bricks of a valid octree in breadth-first order, clipped to its W x H x D voxels.

    children (c, 8); level_sizes: number of nodes of each level; filled (n,): the leaves that count. Some bricks may be
    empty.
    """
    low, solid, parts = _tree(children, level_sizes, filled, np.array(size))
    first_solid = len(low) - len(solid)
    mask = np.zeros((len(low), 8), np.uint64)
    nodes = [np.zeros(0, np.int32)] * (-(-len(low) // _CHUNK) or 1)
    ends = np.array(size) - low
    cut: npt.NDArray[np.bool_] = np.any(ends < 8, axis=1)

    def work(begin: int, end: int) -> None:
        node = np.full((end - begin, 512), _NOBODY, np.int32)
        for part in parts:
            reach = np.minimum([begin << 9, end << 9], np.iinfo(part.cell.dtype).max).astype(part.cell.dtype)
            own = slice(*np.searchsorted(part.cell, reach))
            cell = part.cell[own].astype(np.int64) - (begin << 9)
            node.reshape(-1)[cell[:, None] + _cube(part.edge)] = part.node[own, None]
        if end > first_solid:
            node[max(first_solid - begin, 0) :] = solid[max(begin - first_solid, 0) : end - first_solid, None]
        if len(beyond := np.flatnonzero(cut[begin:end])):
            node[beyond] = np.where(_inside(ends[begin + beyond]), node[beyond], _NOBODY)
        held = node != _NOBODY
        mask[begin:end] = np.packbits(held, axis=1, bitorder="little").view("<u8")
        nodes[begin // _CHUNK] = node[held]

    over_chunks(work, len(low), _CHUNK)
    parts.clear()  # for a large octree they take as much memory as the result
    return Bricks(low, mask, np.concatenate(nodes))


def _tree(
    children: npt.NDArray[np.int32], level_sizes: list[int], filled: npt.NDArray[np.bool_], size: Ints
) -> tuple[Ints, NodeNumbers, list[_Part]]:
    """Return (p, 3) bricks, (s,) the larger leaves that fill the last s bricks, and the leaves of the other bricks."""
    edge = 1 << max(int(side) - 1 for side in size).bit_length()
    corner, cell = np.zeros((1, 3), np.int64), np.zeros(1, np.int32)
    low, solid, parts = [np.zeros((0, 3), np.int64)], [np.zeros(0, np.int32)], []
    start = above = 0
    for nodes in level_sizes:
        if start:
            edge //= 2
            corner, cell = _below(children[above:start], corner, cell, nodes, edge)
        own = filled[start : start + nodes]
        if edge > 8:
            pieces, of = _pieces(corner[own], edge, size)
            low.append(pieces)
            solid.append((start + np.flatnonzero(own)).astype(np.int32)[of])
        else:
            parts.append(_Part(_numbers(own, start), cell[own], edge))
        start, above = start + nodes, start
    bricks = corner if edge <= 8 else corner[:0]
    return np.concatenate([bricks, *low]), np.concatenate(solid), parts


def _below(
    table: npt.NDArray[np.int32], corner: Ints, cell: npt.NDArray[Any], nodes: int, edge: int
) -> tuple[Ints, npt.NDArray[Any]]:
    """The corners, or the cells, of the next level from those of the level with these child slots.

    One part at a time: the last level of a large octree alone takes most of the memory limit.
    """
    large = edge >= 8
    made = np.empty((nodes, 3), np.int64) if large else np.empty(nodes, cell.dtype)
    step = edge * ((np.arange(8) & 1) << 6 | (np.arange(8) >> 1 & 1) << 3 | np.arange(8) >> 2)  # to an octant's slot
    done = 0
    for begin in range(0, len(table), _ROWS):
        slots = np.flatnonzero(table[begin : begin + _ROWS].reshape(-1) != 0)
        parent, octant = begin + (slots >> 3), slots & 7
        some = slice(done, done + len(slots))
        if large:
            made[some] = corner[parent] + (octant[:, None] >> np.arange(3) & 1) * edge
        else:
            made[some] = cell[parent] + step[octant]
        done += len(slots)
    if large:
        # Brick number and slot in one integer, with 32 bits if they fit.
        numbers: npt.NDArray[Any] = np.arange(nodes, dtype=np.int32 if nodes < _FEW else np.int64)
        return made, numbers << 9
    return corner, made


def _numbers(own: npt.NDArray[np.bool_], start: int) -> NodeNumbers:
    """The numbers of the True entries, counted from `start`; one part at a time."""
    numbers, done = np.empty(int(np.count_nonzero(own)), np.int32), 0
    for begin in range(0, len(own), _ROWS):
        found = np.flatnonzero(own[begin : begin + _ROWS])
        numbers[done : done + len(found)] = start + begin + found
        done += len(found)
    return numbers


def _pieces(corner: Ints, edge: int, size: Ints) -> tuple[Ints, Ints]:
    """(s, 3) the bricks of larger cubes, as far as they are inside the grid, and (s,) the cube of each."""
    if not len(corner):
        return corner, np.zeros(0, np.int64)
    reach = np.minimum(edge, (size - corner).max(axis=0))
    steps = np.stack(np.meshgrid(*(np.arange(0, side, 8) for side in reach), indexing="ij"), axis=-1).reshape(-1, 3)
    low = (corner[:, None] + steps).reshape(-1, 3)
    held = np.flatnonzero((low < size).all(axis=1))
    return low[held], held // len(steps)


def _cube(edge: int) -> Ints:
    """(edge^3,) slots of the lowest cube of this edge in a brick."""
    x, y, z = np.indices((edge, edge, edge)).reshape(3, -1)
    return x << 6 | y << 3 | z


def _inside(ends: Ints) -> npt.NDArray[np.bool_]:
    """(q, 512) whether slots are inside the grid; ends (q, 3): from each brick to the end of the grid."""
    x, y, z = (np.arange(8) < ends[:, axis, None] for axis in range(3))
    return (x[:, :, None, None] & y[:, None, :, None] & z[:, None, None, :]).reshape(-1, 512)
