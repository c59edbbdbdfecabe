"""Tiles of a VDB tree: cubes that have one value each, in place of nodes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Coords, Words
from nerfbake.kernels.vdb.bitmask import popcount

TILE_EDGES = (8, 128, 4096)  # voxels along a tile in a lower node, in an upper node, in the root


class Cubes(NamedTuple):
    """low (q, 3) int32 lowest voxels of cubes that are `edge` voxels wide."""

    low: Coords
    edge: int


@dataclass(frozen=True, eq=False)
class VdbTiles:
    """Cubes of one value each, in place of nodes.

    lower_mask (k, 64) uint64   the slots of each lower node that are such cubes, of 8^3 voxels
    upper_mask (u, 512) uint64  the same of each upper node, 128^3
    root_origin (r, 3) int32    lowest voxel of cubes of 4096^3, in the order of root_keys()
    """

    lower_mask: Words
    upper_mask: Words
    root_origin: Coords

    @cached_property
    def counts(self) -> tuple[int, int, int]:
        """Tiles of 8^3, of 128^3, of 4096^3."""
        return int(popcount(self.lower_mask).sum()), int(popcount(self.upper_mask).sum()), len(self.root_origin)


def no_tiles(upper_mask: Words, lower_mask: Words) -> VdbTiles:
    """None at all, in the shape that masks of children have."""
    return VdbTiles(np.zeros_like(lower_mask), np.zeros_like(upper_mask), np.zeros((0, 3), np.int32))
