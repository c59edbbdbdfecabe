"""Reads of a VDB tree at points: masks and popcounts down to a leaf, and the leaf kept for the next read.

rank[node, word] counts the children before a word of all nodes' masks, so that the child in a slot is number
rank + popcount(word below the slot's bit): a tree needs no pointers. The kept leaf is what the VDB papers call an
accessor; neighbouring points mostly find theirs in it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.bitmask import Ints, Words, exclusive_sum
from nerfbake.kernels.jit import compiled

BLOCK = 1 << 12  # points that share a kept leaf
FAR = float(1 << 30)  # beyond lies nothing, and whole numbers would end soon
NOTHING = -1


class Tables(NamedTuple):
    """A tree's masks with their ranks, and its root tiles' numbers (u, 3)."""

    tiles: Ints
    upper: Words
    upper_rank: Ints
    lower: Words
    lower_rank: Ints
    leaf: Words
    leaf_rank: Ints


def tables_of(root_origin: npt.NDArray[np.int32], upper: Words, lower: Words, leaf: Words) -> Tables:
    ranks = [exclusive_sum(np.bitwise_count(masks).ravel().astype(np.int64)) for masks in (upper, lower, leaf)]
    up, low, end = (rank.reshape(masks.shape) for rank, masks in zip(ranks, (upper, lower, leaf), strict=True))
    return Tables(root_origin.astype(np.int64) >> 12, upper, up, lower, low, leaf, end)


@compiled(parallel=True)
def sample_points(
    tables: Tables,
    values: npt.NDArray[np.float32],
    background: npt.NDArray[np.float32],
    points: npt.NDArray[np.float64],
    corners: int,
    out: npt.NDArray[np.float32],
) -> None:
    """out (n, C): at points (n, 3) in voxels, whose centres are whole numbers; corners 1 nearest, 2 trilinear.

    values (m, C) of the active voxels, background (C,) of all others.
    """
    for block in prange((len(points) + BLOCK - 1) // BLOCK):
        cached, c0, c1, c2 = NOTHING, FAR, FAR, FAR
        for i in range(block * BLOCK, min((block + 1) * BLOCK, len(points))):
            p0, p1, p2 = points[i, 0], points[i, 1], points[i, 2]
            if not (abs(p0) < FAR and abs(p1) < FAR and abs(p2) < FAR):
                out[i] = background
                continue
            shift = 0.5 if corners == 1 else 0.0
            x, y, z = int(np.floor(p0 + shift)), int(np.floor(p1 + shift)), int(np.floor(p2 + shift))
            f0, f1, f2 = p0 - x, p1 - y, p2 - z
            out[i] = 0
            for corner in range(corners * corners * corners):
                dx, dy, dz = corner >> 2, corner >> 1 & 1, corner & 1
                if corners == 1:
                    weight = np.float32(1)
                else:
                    w0, w1, w2 = f0 if dx else 1 - f0, f1 if dy else 1 - f1, f2 if dz else 1 - f2
                    weight = np.float32(w0 * w1 * w2)
                v0, v1, v2 = x + dx, y + dy, z + dz
                if v0 >> 3 != c0 or v1 >> 3 != c1 or v2 >> 3 != c2:
                    cached, c0, c1, c2 = _leaf_at(tables, v0, v1, v2), v0 >> 3, v1 >> 3, v2 >> 3
                row = NOTHING
                if cached != NOTHING:
                    word = v0 & 7
                    row = _child(tables.leaf[cached, word], tables.leaf_rank[cached, word], (v1 & 7) << 3 | v2 & 7)
                for c in range(out.shape[1]):
                    out[i, c] += weight * (background[c] if row == NOTHING else values[row, c])


@compiled()
def _leaf_at(tables: Tables, x: int, y: int, z: int) -> int:
    """The number of the leaf that would hold this voxel, or NOTHING."""
    node = NOTHING
    for tile in range(len(tables.tiles)):
        if tables.tiles[tile, 0] == x >> 12 and tables.tiles[tile, 1] == y >> 12 and tables.tiles[tile, 2] == z >> 12:
            node = tile
    if node == NOTHING:
        return NOTHING
    slot = (x >> 7 & 31) << 10 | (y >> 7 & 31) << 5 | z >> 7 & 31
    node = _child(tables.upper[node, slot >> 6], tables.upper_rank[node, slot >> 6], slot & 63)
    if node == NOTHING:
        return NOTHING
    slot = (x >> 3 & 15) << 8 | (y >> 3 & 15) << 4 | z >> 3 & 15
    return _child(tables.lower[node, slot >> 6], tables.lower_rank[node, slot >> 6], slot & 63)


@compiled()
def _child(word: np.uint64, rank: int, bit: int) -> int:
    """The number of the child whose bit this is, or NOTHING where the bit is not set."""
    if not word >> np.uint64(bit) & np.uint64(1):
        return NOTHING
    # Bits counted in pairs, fours, eights, and all eights added up by a product; compilers know it as popcnt.
    bits = word & ((np.uint64(1) << np.uint64(bit)) - np.uint64(1))
    bits = bits - (bits >> np.uint64(1) & np.uint64(0x5555555555555555))
    bits = (bits & np.uint64(0x3333333333333333)) + (bits >> np.uint64(2) & np.uint64(0x3333333333333333))
    bits = bits + (bits >> np.uint64(4)) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int(rank + np.int64(bits * np.uint64(0x0101010101010101) >> np.uint64(56)))
