"""From voxels, or leaves of them, to the VDB tree over them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints, Words
from nerfbake.kernels.vdb.bitmask import group_bits
from nerfbake.kernels.vdb.slots import ROOT_BITS, root_keys
from nerfbake.scene.vdb_topology import VdbTopology

LEAF_BITS, LOWER_BITS, UPPER_BITS = 9, 12, 15
_STEPS = ((5, 7), (4, 3), (3, 0))  # bits of a slot along an axis, and the coordinate's bits below them


def topology_of(coords: npt.NDArray[np.integer[Any]]) -> tuple[VdbTopology, Ints]:
    """The tree over these voxels, and the order that sorts them: (m, 3) -> topology, (m,).

    Raises InvalidScene where a voxel comes twice or lies beyond 32 bits.
    """
    if len(coords) and not -(1 << 31) <= int(coords.min()) <= int(coords.max()) < 1 << 31:
        raise InvalidScene(Problem("a voxel", f"lies at {int(np.abs(coords).max())}", "coordinates of 32 bits"))
    tiles, key = _paths(coords, _STEPS)
    order = _sorting(key, coords, "voxel")
    leaves, leaf_mask = group_bits(key[order], LEAF_BITS)
    return _topology(tiles, leaves, leaf_mask), order


def topology_of_leaves(low: npt.NDArray[np.integer[Any]], masks: Words) -> tuple[VdbTopology, Ints]:
    """The same from leaves: (l, 3) multiples of 8 and (l, 8) masks -> topology, the order of those not empty."""
    held = np.flatnonzero(masks.any(axis=1))
    tiles, key = _paths(low[held], _STEPS[:2])
    order = _sorting(key, low[held], "leaf")
    return _topology(tiles, key[order], masks[held[order]]), held[order]


def _paths(coords: npt.NDArray[np.integer[Any]], steps: tuple[tuple[int, int], ...]) -> tuple[Ints, Ints]:
    """The root's tiles by number, and (m,) the row among them and the slots on the way to each voxel."""
    keys = root_keys(coords)
    # One tile is the rule: numbering it needs no sort.
    one = not len(keys) or bool((keys == keys[0]).all())
    tiles, key = (keys[:1], np.zeros(len(keys), np.int64)) if one else np.unique(keys, return_inverse=True)
    for width, shift in steps:
        for axis in range(3):
            key = key << width | coords[:, axis].astype(np.int64) >> shift & (1 << width) - 1
    return tiles, key


def _sorting(key: Ints, coords: npt.NDArray[np.integer[Any]], what: str) -> Ints:
    """The order that sorts the keys. Raises InvalidScene where one comes twice."""
    order = np.argsort(key)
    if len(twice := np.flatnonzero(np.diff(key[order]) == 0)):
        place = ", ".join(map(str, coords[order[twice[0]]]))
        raise InvalidScene(Problem(f"{what} ({place})", "is there twice", f"each {what} once"))
    return order


def _topology(tiles: Ints, leaves: Ints, leaf_mask: Words) -> VdbTopology:
    """From (l,) sorted paths of leaves."""
    lowers, lower_mask = group_bits(leaves, LOWER_BITS)
    _, upper_mask = group_bits(lowers, UPPER_BITS)
    half = 1 << ROOT_BITS - 1
    tile_numbers = np.stack([tiles >> 42, tiles >> 21, tiles], axis=1) & (1 << ROOT_BITS) - 1
    root_origin = ((tile_numbers + half) % (2 * half) - half) * 4096  # two's complement of 20 bits
    return VdbTopology(root_origin.astype(np.int32), upper_mask, lower_mask, leaf_mask)
