"""Multiresolution hash grids: features of points, interpolated between the nodes of each level.

One kernel serves nerfstudio's own grids, tiny-cuda-nn's and torch-ngp's. They differ in the scale of a level, in the
shift of its nodes, and in the nodes along an axis of a level that is stored densely.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Ints, Singles, as_input, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

_PRIMES = np.uint64(2654435761), np.uint64(805459861)  # of the hash; x has the factor 1
_WORD = np.uint64(0xFFFFFFFF)
_BLOCK = 4096  # points at a time, for which one level's features are computed


class Levels(NamedTuple):
    """The levels of a grid.

    table  (n, F) float32: the rows of all levels
    first  (L + 1,) int64: the first row of each level, and n
    scale  (L,) float32 and shift: point p is at p * scale + shift, in nodes
    dense  (L,) int64: nodes along an axis of a level that is stored with x fastest; 0: rows are found by hashing
    """

    table: Singles
    first: Ints
    scale: Singles
    shift: float
    dense: Ints


def grid_features(levels: Levels, points: Singles) -> Singles:
    """(L F, m) float32 features of points (m, 3) float32 in the unit cube, level by level."""
    out = np.empty((len(levels.scale) * levels.table.shape[1], len(points)), np.float32)
    shift = np.float32(levels.shift)
    _interpolate(levels.table, levels.first, levels.scale, shift, levels.dense, as_input(points), out)
    return out


@on_every_core
@compiled()
def _interpolate(
    core: int,
    cores: int,
    table: Singles,
    first: Ints,
    scale: Singles,
    shift: np.float32,
    dense: Ints,
    points: Singles,
    out: Singles,
) -> None:
    m, F, L = len(points), table.shape[1], len(scale)
    for block in range(core, (m + _BLOCK - 1) // _BLOCK, cores):
        begin, end = block * _BLOCK, min((block + 1) * _BLOCK, m)
        for level in range(L):
            s, start = scale[level], first[level]
            rows, edge = np.uint64(first[level + 1] - start), np.uint64(dense[level])
            for p in range(begin, end):
                x, y, z = points[p, 0] * s + shift, points[p, 1] * s + shift, points[p, 2] * s + shift
                fx, fy, fz = np.floor(x), np.floor(y), np.floor(z)
                i, j, k = np.uint64(np.int64(fx)), np.uint64(np.int64(fy)), np.uint64(np.int64(fz))
                x, y, z = x - fx, y - fy, z - fz
                for f in range(F):
                    out[level * F + f, p] = f32(0)
                for corner in range(8):
                    a, b, c = np.uint64(corner & 1), np.uint64(corner >> 1 & 1), np.uint64(corner >> 2)
                    weight = (x if a else f32(1) - x) * (y if b else f32(1) - y) * (z if c else f32(1) - z)
                    if edge:
                        place = (i + a) + edge * ((j + b) + edge * (k + c))
                    else:
                        place = (i + a) ^ (j + b) * _PRIMES[0] ^ (k + c) * _PRIMES[1]
                        place &= _WORD
                    row = start + np.int64(place % rows)
                    for f in range(F):
                        out[level * F + f, p] += weight * table[row, f]
