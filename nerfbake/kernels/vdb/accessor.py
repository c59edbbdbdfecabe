"""Reads of a VDB tree at points: masks and popcounts lead down to a leaf, and the leaf is kept for the next read.

Every mask word is stored beside the number of children before it, over all words of all nodes, so the child in a slot
has the number rank + popcount(word below the slot's bit): a tree needs no pointers, and a step reads one cache line.
The VDB papers call the kept leaf an accessor; neighbouring points are mostly in the same leaf. Each table ends with a
node without children, which stands for everything that does not exist, so the descent has no branches.

Trilinear reads process blocks of points in steps (leaves, then rows, then values), so a point does not wait for the
memory of the previous one: half the time of one point after the other on a million random points. Node numbers are
uint64, because numba tests every signed index for being negative.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints, Points, Singles, Words
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.vdb.bitmask import FAR, exclusive_sum, slots_of

_BLOCK = 64  # points whose leaves are found before the first is read: their positions stay in the first-level cache
_FAR = float(FAR)
NO_LEAF = 1 << 40
U = np.uint64
F = np.float32


class Tables(NamedTuple):
    """A tree prepared for reading.

    tiles (u, 3) int64: the numbers of the tiles; upper, lower, leaf: all mask words of upper nodes (512 each), of lower
    nodes (64) and of leaves (8), each with the number of its first child, (w, 2) uint64. Each ends with an empty node.
    Leaves count voxels from 1: row 0 of a table of values is the background.
    """

    tiles: Ints
    upper: Words
    lower: Words
    leaf: Words


def tables_of(root_origin: npt.NDArray[np.int32], upper: Words, lower: Words, leaf: Words) -> Tables:
    return Tables(root_origin.astype(np.int64) >> 12, _ranked(upper, 0), _ranked(lower, 0), _ranked(leaf, 1))


def _ranked(masks: Words, first: int) -> Words:
    words = np.zeros((masks.size + masks.shape[1], 2), U)
    words[: masks.size, 0] = masks.ravel()
    words[: masks.size, 1] = first + exclusive_sum(np.bitwise_count(masks).ravel().astype(np.int64))
    return words


def dense_leaves(leaf_mask: Words, table: Singles) -> Singles:
    """((l + 1) 512, C) rows of all voxels of all leaves, and of one empty leaf.

    table (m + 1, C): row 0 is the background.
    """
    leaves = np.empty((len(leaf_mask) + 1, 512, table.shape[1]), F)
    leaves[:] = table[0]
    leaves[slots_of(leaf_mask)] = table[1:]
    return leaves.reshape(-1, table.shape[1])


@compiled()
def nearest(tables: Tables, dense: bool, table: Singles, points: Points, out: Singles) -> None:
    """Fill out (n, C) with the values at points (n, 3) in voxels, whose centres are integers.

    table (m + 1, C): the background's row, then the active voxels' rows; if dense, the result of dense_leaves().
    """
    leaf, c0, c1, c2 = U(0), NO_LEAF, NO_LEAF, NO_LEAF
    for i in range(len(points)):
        p0, p1, p2 = _bounded(points[i, 0]), _bounded(points[i, 1]), _bounded(points[i, 2])
        x, y, z = int(np.floor(p0 + 0.5)), int(np.floor(p1 + 0.5)), int(np.floor(p2 + 0.5))
        if (x >> 3 ^ c0) | (y >> 3 ^ c1) | (z >> 3 ^ c2):
            leaf, c0, c1, c2 = leaf_at(tables, x, y, z), x >> 3, y >> 3, z >> 3
        voxel = voxel_of(leaf, x, y, z)
        row = voxel if dense else child_of(tables.leaf, voxel, U(0))
        for k in range(out.shape[1]):
            out[i, k] = table[row, k]


@compiled()
def trilinear(tables: Tables, dense: bool, table: Singles, points: Points, out: Singles) -> None:
    """Like nearest(), but interpolated trilinearly between the eight voxels around each point."""
    rows, parts, flat = np.empty((_BLOCK, 8), U), np.empty((_BLOCK, 3), F), table.reshape(-1)
    crossing, places = np.empty(_BLOCK, U), np.empty((_BLOCK, 3), np.int64)
    for start in range(0, len(points), _BLOCK):
        count = min(_BLOCK, len(points) - start)
        _voxels_around(tables, points[start : start + count], rows, parts, crossing, places)
        if not dense:
            for i in range(count):
                for k in range(8):
                    rows[i, k] = child_of(tables.leaf, rows[i, k], U(0))
        if out.shape[1] == 1:  # a loop with one iteration per point would cost as much as everything else
            for i in range(count):
                a, b, c, d = flat[rows[i, 0]], flat[rows[i, 1]], flat[rows[i, 2]], flat[rows[i, 3]]
                e, f, g, h = flat[rows[i, 4]], flat[rows[i, 5]], flat[rows[i, 6]], flat[rows[i, 7]]
                out[start + i, 0] = interpolate(a, b, c, d, e, f, g, h, parts[i, 0], parts[i, 1], parts[i, 2])
        else:
            for i in range(count):
                r0, r1, r2, r3 = rows[i, 0], rows[i, 1], rows[i, 2], rows[i, 3]
                r4, r5, r6, r7 = rows[i, 4], rows[i, 5], rows[i, 6], rows[i, 7]
                f0, f1, f2 = parts[i, 0], parts[i, 1], parts[i, 2]
                for k in range(out.shape[1]):
                    a, b, c, d = table[r0, k], table[r1, k], table[r2, k], table[r3, k]
                    e, f, g, h = table[r4, k], table[r5, k], table[r6, k], table[r7, k]
                    out[start + i, k] = interpolate(a, b, c, d, e, f, g, h, f0, f1, f2)


@compiled()
def _voxels_around(
    tables: Tables, points: Points, voxels: Words, parts: Singles, crossing: Words, places: Ints
) -> None:
    """Fill (n, 8) the numbers of the voxels around each point, z fastest, and (n, 3) its offset from the first of them.

    crossing and places are buffers.
    """
    leaf, c0, c1, c2 = U(0), NO_LEAF, NO_LEAF, NO_LEAF
    crossings = U(0)
    for i in range(len(points)):
        p0, p1, p2 = _bounded(points[i, 0]), _bounded(points[i, 1]), _bounded(points[i, 2])
        x, y, z = int(np.floor(p0)), int(np.floor(p1)), int(np.floor(p2))
        parts[i, 0], parts[i, 1], parts[i, 2] = p0 - x, p1 - y, p2 - z
        if (x >> 3 ^ c0) | (y >> 3 ^ c1) | (z >> 3 ^ c2):
            leaf, c0, c1, c2 = leaf_at(tables, x, y, z), x >> 3, y >> 3, z >> 3
        voxel = voxel_of(leaf, x, y, z)
        for k in range(8):
            voxels[i, k] = voxel + U((k >> 2) << 6 | (k >> 1 & 1) << 3 | k & 1)
        # One point in three is between leaves. They are collected in a list, because CPUs cannot predict such a branch.
        crossing[crossings] = U(i)
        places[crossings, 0], places[crossings, 1], places[crossings, 2] = x, y, z
        crossings += U((x & 7 == 7) | (y & 7 == 7) | (z & 7 == 7))
    for n in range(crossings):
        i, x, y, z = crossing[n], places[n, 0], places[n, 1], places[n, 2]
        across = (4 if x & 7 == 7 else 0) | (2 if y & 7 == 7 else 0) | (1 if z & 7 == 7 else 0)
        for k in range(1, 8):
            x1, y1, z1 = x + (k >> 2), y + (k >> 1 & 1), z + (k & 1)
            leaf = voxels[i, U(k & across)] >> U(9) if k & ~across else leaf_at(tables, x1, y1, z1)
            voxels[i, U(k)] = voxel_of(leaf, x1, y1, z1)


@compiled()
def _bounded(p: float) -> float:
    """Clamp to +-FAR, NaN too: two instructions; a branch for such points took a sixth of the total time."""
    p = p if p > -_FAR else -_FAR
    return p if p < _FAR else _FAR


@compiled()
def interpolate(a: F, b: F, c: F, d: F, e: F, f: F, g: F, h: F, f0: F, f1: F, f2: F) -> F:
    """Interpolate between eight voxels, z fastest."""
    g0, g1, g2 = F(1) - f0, F(1) - f1, F(1) - f2
    low = (a * g2 + b * f2) * g1 + (c * g2 + d * f2) * f1
    high = (e * g2 + f * f2) * g1 + (g * g2 + h * f2) * f1
    return low * g0 + high * f0


@compiled()
def leaf_at(tables: Tables, x: int, y: int, z: int) -> np.uint64:
    """The number of the leaf that contains this voxel, or of the empty leaf."""
    tile = len(tables.tiles)
    for t in range(len(tables.tiles)):
        if tables.tiles[t, 0] == x >> 12 and tables.tiles[t, 1] == y >> 12 and tables.tiles[t, 2] == z >> 12:
            tile = t
            break
    slot = (x >> 7 & 31) << 10 | (y >> 7 & 31) << 5 | z >> 7 & 31
    node = child_of(tables.upper, U(tile) << U(15) | U(slot), U(len(tables.lower) >> 6) - U(1))
    slot = (x >> 3 & 15) << 8 | (y >> 3 & 15) << 4 | z >> 3 & 15
    return child_of(tables.lower, node << U(12) | U(slot), U(len(tables.leaf) >> 3) - U(1))


@compiled()
def voxel_of(leaf: np.uint64, x: int, y: int, z: int) -> np.uint64:
    """The number of a voxel among all voxels of all leaves."""
    return leaf << U(9) | U((x & 7) << 6 | (y & 7) << 3 | z & 7)


@compiled()
def child_of(words: Words, slot: np.uint64, nothing: np.uint64) -> np.uint64:
    """The number of the child in a slot, counted over all nodes, or `nothing` if its bit is not set."""
    word, rank, bit = words[slot >> U(6), 0], words[slot >> U(6), 1], slot & U(63)
    # Count bits in pairs, fours and eights, and add the eights by a product; compilers turn this into popcnt.
    bits = word & ((U(1) << bit) - U(1))
    bits = bits - (bits >> U(1) & U(0x5555555555555555))
    bits = (bits & U(0x3333333333333333)) + (bits >> U(2) & U(0x3333333333333333))
    bits = bits + (bits >> U(4)) & U(0x0F0F0F0F0F0F0F0F)
    return rank + (bits * U(0x0101010101010101) >> U(56)) if word >> bit & U(1) else nothing
