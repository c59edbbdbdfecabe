"""Where the voxels and nodes of a VDB tree stand: keys of root tiles, slots of nodes, and the way back to voxels."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Coords, Ints, Words
from nerfbake.kernels.vdb.bitmask import slots_of

ROOT_BITS = 20  # of a tile's number along an axis
FAR = 1 << 40  # where no tile is, and whole numbers have not yet ended


def root_keys(coords: npt.NDArray[np.integer[Any]]) -> Ints:
    """(m,) the numbers by which root tiles are sorted, those that NanoVDB gives them; coords (m, 3)."""
    x, y, z = (coords[:, axis].astype(np.int64) >> 12 & (1 << ROOT_BITS) - 1 for axis in range(3))
    return x << 42 | y << 21 | z


def slots_at(coords: npt.NDArray[np.integer[Any]], bits: int, shift: int) -> Ints:
    """(q,) the slot of each voxel in a node that has 2^bits of them along an axis, each 2^shift voxels wide."""
    x, y, z = (coords[:, axis].astype(np.int64) >> shift & (1 << bits) - 1 for axis in range(3))
    return x << 2 * bits | y << bits | z


def tiles_at(keys: Ints, wanted: Ints, coords: npt.NDArray[np.integer[Any]]) -> Ints:
    """(q,) where each wanted key stands among sorted ones, -1 where it does not, or lies beyond 32 bits."""
    if not len(keys):
        return np.full(len(wanted), -1)
    place = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    near = ((coords >= -(1 << 31)) & (coords < 1 << 31)).all(axis=1)
    return np.where((keys[place] == wanted) & near, place, -1)


def origins_of(above: Coords, masks: Words, bits: int, width: int) -> Coords:
    """(p, 3) the lowest voxel of what each set bit stands for: `above` are those of the nodes, whose slots, 2^bits
    along an axis, are `width` voxels wide."""
    row, slot = slots_of(masks)
    low = (1 << bits) - 1
    step = np.stack([slot >> 2 * bits, slot >> bits & low, slot & low], axis=1).astype(np.int32)
    return above[row] + step * np.int32(width)
