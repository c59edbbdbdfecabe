"""The VDB tree, 5-4-3: a root of 4096^3 tiles, upper nodes of 32^3, lower nodes of 16^3, leaves of 8^3 voxels.

Slots are x-major. For the voxel (x, y, z), from the leaf to the root:

    voxel in leaf     (x & 7) << 6        | (y & 7) << 3        | z & 7
    leaf in lower     (x >> 3 & 15) << 8  | (y >> 3 & 15) << 4  | z >> 3 & 15
    lower in upper    (x >> 7 & 31) << 10 | (y >> 7 & 31) << 5  | z >> 7 & 31
    tile in root      (x >> 12) << 42     | (y >> 12) << 21     | z >> 12, each cut to 20 bits

Sorting by the slots from the root to the leaf puts every level into breadth-first order. The masks alone then define
which node is the child of which: no offsets are stored, and no origins except the root's. Instead of a child, a slot
may have a tile: a cube with one value.

topology_of() and topology_of_leaves() build the tree from voxels or leaves.

Source: docs/formats/vdb.md, "The VDB tree"; PlenVDB (docs/sources.md, "PlenVDB"), section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Coords, Ints, Words
from nerfbake.kernels.soundness import count_problem, plural
from nerfbake.kernels.vdb.bitmask import (
    ROOT_BITS,
    bits_kept,
    exclusive_sum,
    group_bits,
    numbers_of,
    origins_of,
    popcount,
    root_keys,
    rows_of_runs,
    slots_at,
    tiles_at,
)

LEAF_BITS, LOWER_BITS, UPPER_BITS = 9, 12, 15
_STEPS = ((5, 7), (4, 3), (3, 0))  # bits of a slot along an axis, and the number of lower bits of the coordinate


def topology_of(coords: npt.NDArray[np.integer[Any]]) -> tuple[VdbTopology, Ints]:
    """Build the tree over these voxels: (m, 3) -> topology, and the order (m,) that sorts the voxels.

    Raises InvalidScene if a voxel occurs twice or its coordinates exceed 32 bits.
    """
    if len(coords) and not -(1 << 31) <= int(coords.min()) <= int(coords.max()) < 1 << 31:
        raise InvalidScene(Problem("a voxel", f"lies at {int(np.abs(coords).max())}", "coordinates of 32 bits"))
    tiles, key = _paths(coords, _STEPS)
    order = _sorting(key, coords, "voxel")
    leaves, leaf_mask = group_bits(key[order], LEAF_BITS)
    return _topology(tiles, leaves, leaf_mask), order


def topology_of_leaves(low: npt.NDArray[np.integer[Any]], masks: Words) -> tuple[VdbTopology, Ints]:
    """Build the tree over leaves: (l, 3) multiples of 8 and (l, 8) masks -> topology.

    Also returns the order that sorts the non-empty leaves.
    """
    held = np.flatnonzero(masks.any(axis=1))
    tiles, key = _paths(low[held], _STEPS[:2])
    order = _sorting(key, low[held], "leaf")
    return _topology(tiles, key[order], masks[held[order]]), held[order]


def _paths(coords: npt.NDArray[np.integer[Any]], steps: tuple[tuple[int, int], ...]) -> tuple[Ints, Ints]:
    """The root tiles by number; and (m,) keys of the root tile's row and the slots on the path to each voxel."""
    keys = root_keys(coords)
    # Most trees have one root tile, which needs no sort.
    one = not len(keys) or bool((keys == keys[0]).all())
    tiles, key = (keys[:1], np.zeros(len(keys), np.int64)) if one else np.unique(keys, return_inverse=True)
    for width, shift in steps:
        for axis in range(3):
            key = key << width | coords[:, axis].astype(np.int64) >> shift & (1 << width) - 1
    return tiles, key


def _sorting(key: Ints, coords: npt.NDArray[np.integer[Any]], what: str) -> Ints:
    """The order that sorts the keys. Raises InvalidScene if a key occurs twice."""
    order = np.argsort(key)
    if len(twice := np.flatnonzero(np.diff(key[order]) == 0)):
        place = ", ".join(map(str, coords[order[twice[0]]]))
        raise InvalidScene(Problem(f"{what} ({place})", "occurs twice", f"each {what} once"))
    return order


def _topology(tiles: Ints, leaves: Ints, leaf_mask: Words) -> VdbTopology:
    """Build the topology from sorted keys of leaves (l,)."""
    lowers, lower_mask = group_bits(leaves, LOWER_BITS)
    _, upper_mask = group_bits(lowers, UPPER_BITS)
    half = 1 << ROOT_BITS - 1
    tile_numbers = np.stack([tiles >> 42, tiles >> 21, tiles], axis=1) & (1 << ROOT_BITS) - 1
    root_origin = ((tile_numbers + half) % (2 * half) - half) * 4096  # two's complement of 20 bits
    return VdbTopology(root_origin.astype(np.int32), upper_mask, lower_mask, leaf_mask)


TILE_EDGES = (8, 128, 4096)  # voxels along a tile in a lower node, in an upper node, in the root


class Cubes(NamedTuple):
    """low (q, 3) int32: lowest voxels of cubes that are `edge` voxels wide."""

    low: Coords
    edge: int


@dataclass(frozen=True, eq=False)
class VdbTiles:
    """Tiles: cubes with one value each, in place of nodes.

    lower_mask (k, 64) uint64   the slots of each lower node that are tiles, of 8^3 voxels
    upper_mask (u, 512) uint64  the slots of each upper node that are tiles, of 128^3 voxels
    root_origin (r, 3) int32    lowest voxel of tiles of 4096^3, in the order of root_keys()
    """

    lower_mask: Words
    upper_mask: Words
    root_origin: Coords

    @cached_property
    def counts(self) -> tuple[int, int, int]:
        """Number of tiles of 8^3, of 128^3, of 4096^3."""
        return int(popcount(self.lower_mask).sum()), int(popcount(self.upper_mask).sum()), len(self.root_origin)


def no_tiles(upper_mask: Words, lower_mask: Words) -> VdbTiles:
    """A VdbTiles without tiles, for these child masks."""
    return VdbTiles(np.zeros_like(lower_mask), np.zeros_like(upper_mask), np.zeros((0, 3), np.int32))


@dataclass(frozen=True, eq=False)
class VdbTopology:
    """The voxels and tiles that have a value: in nearly all grids those that are active.

    root_origin (u, 3) int32   lowest voxel of each upper node, multiples of 4096, in the order of root_keys()
    upper_mask  (u, 512) uint64  the lower nodes of each upper node
    lower_mask  (k, 64) uint64   the leaves of each lower node
    leaf_mask   (l, 8) uint64    the voxels of each leaf; m in total
    tiles       None if there are none

    Order of the values: the voxels, leaf after leaf, then the tiles of 8^3, of 128^3, of 4096^3.
    """

    root_origin: Coords
    upper_mask: Words
    lower_mask: Words
    leaf_mask: Words
    tiles: VdbTiles | None = None

    def __post_init__(self) -> None:
        _require_shape("root_origin", self.root_origin, 3, np.int32)
        for name, width in (("upper_mask", 512), ("lower_mask", 64), ("leaf_mask", 8)):
            _require_shape(name, getattr(self, name), width, np.uint64)
        if len(self.root_origin) != len(self.upper_mask):
            found = f"has {plural(len(self.upper_mask), 'row')}"
            raise InvalidScene(Problem("upper_mask", found, f"{len(self.root_origin):,}, as in root_origin"))
        if self.tiles is not None:
            _require_shape("tiles.root_origin", self.tiles.root_origin, 3, np.int32)
            for name in ("upper_mask", "lower_mask"):
                if getattr(self.tiles, name).shape != getattr(self, name).shape:
                    found = f"has shape {getattr(self.tiles, name).shape}"
                    raise InvalidScene(Problem(f"tiles.{name}", found, f"{getattr(self, name).shape}, as {name}"))
            if not any(self.tiles.counts):
                object.__setattr__(self, "tiles", None)

    # -- sizes -------------------------------------------------------------------------------------------------
    @property
    def node_counts(self) -> tuple[int, int, int]:
        """Number of upper nodes, lower nodes, leaves."""
        return len(self.upper_mask), len(self.lower_mask), len(self.leaf_mask)

    @property
    def tile_counts(self) -> tuple[int, int, int]:
        """Number of tiles of 8^3, of 128^3, of 4096^3."""
        return self.tiles.counts if self.tiles else (0, 0, 0)

    @cached_property
    def m(self) -> int:
        """Number of voxels in leaves."""
        return int(popcount(self.leaf_mask).sum())

    @property
    def count(self) -> int:
        """Number of values: of voxels in leaves and of tiles."""
        return self.m + sum(self.tile_counts)

    @property
    def voxel_count(self) -> int:
        """Number of voxels in leaves and in tiles."""
        return self.m + sum(count * edge**3 for count, edge in zip(self.tile_counts, TILE_EDGES, strict=True))

    # -- places ------------------------------------------------------------------------------------------------
    @cached_property
    def first(self) -> Ints:
        """(l,) the index of each leaf's first voxel."""
        return exclusive_sum(popcount(self.leaf_mask))

    @cached_property
    def lower_origin(self) -> Coords:
        """(k, 3) lowest voxel of each lower node."""
        return origins_of(self.root_origin, self.upper_mask, 5, 128)

    @cached_property
    def leaf_origin(self) -> Coords:
        """(l, 3) lowest voxel of each leaf."""
        return origins_of(self.lower_origin, self.lower_mask, 4, 8)

    @property
    def coords(self) -> Coords:
        """(m, 3) coordinates of the voxels in leaves, in order."""
        return origins_of(self.leaf_origin, self.leaf_mask, 3, 1)

    @property
    def tile_cubes(self) -> list[Cubes]:
        """The tiles of 8^3, of 128^3, of 4096^3, in order; an empty list if there are none."""
        if self.tiles is None:
            return []
        lower = origins_of(self.lower_origin, self.tiles.lower_mask, 4, 8)
        upper = origins_of(self.root_origin, self.tiles.upper_mask, 5, 128)
        return [Cubes(low, edge) for low, edge in zip((lower, upper, self.tiles.root_origin), TILE_EDGES, strict=True)]

    @cached_property
    def box(self) -> tuple[Ints, Ints] | None:
        """The lowest and the highest voxel on each axis, both included; None if there are no voxels."""
        held = self.leaf_mask.any(axis=1)
        low, high = self.leaf_boxes
        ends = [(low[held], high[held])]
        ends += [(low.astype(np.int64), low.astype(np.int64) + edge - 1) for low, edge in self.tile_cubes]
        low, high = (np.concatenate([pair[side] for pair in ends]) for side in (0, 1))
        return (low.min(axis=0), high.max(axis=0)) if len(low) else None

    @cached_property
    def leaf_boxes(self) -> tuple[Ints, Ints]:
        """(l, 3) lowest and highest voxel of each leaf; the whole cube for an empty leaf."""
        octets = np.unpackbits(self.leaf_mask.astype("<u8").view(np.uint8).reshape(-1, 64), axis=1, bitorder="little")
        solid = octets.reshape(-1, 8, 8, 8)
        low, high = np.empty((len(solid), 3), np.int64), np.empty((len(solid), 3), np.int64)
        for axis, others in enumerate(((2, 3), (1, 3), (1, 2))):
            used: npt.NDArray[np.bool_] = np.any(solid, axis=others)
            low[:, axis], high[:, axis] = used.argmax(axis=1), 7 - used[:, ::-1].argmax(axis=1)
        return low + self.leaf_origin, high + self.leaf_origin

    @cached_property
    def tables(self) -> Any:
        """The masks with their ranks, for kernels.vdb.accessor."""
        from nerfbake.kernels.vdb.accessor import tables_of

        return tables_of(self.root_origin, self.upper_mask, self.lower_mask, self.leaf_mask)

    # -- lookups -----------------------------------------------------------------------------------------------
    def nodes_at(self, coords: npt.NDArray[np.integer[Any]]) -> list[Ints]:
        """The upper node, the lower node and the leaf around each voxel (q, 3): three arrays (q,), -1 for none."""
        keys, own = root_keys(coords), root_keys(self.root_origin)
        upper = tiles_at(own, keys, coords)
        lower = numbers_of(self.upper_mask, upper, slots_at(coords, 5, 7))
        return [upper, lower, numbers_of(self.lower_mask, lower, slots_at(coords, 4, 3))]

    def rows_at(self, coords: npt.NDArray[np.integer[Any]]) -> Ints:
        """The index of each voxel's value (q,), in a leaf or a tile, for voxels (q, 3); -1 if it has none."""
        upper, lower, leaf = self.nodes_at(coords)
        rows = numbers_of(self.leaf_mask, leaf, slots_at(coords, 3, 0))
        if self.tiles is None:
            return rows
        tiles, (small, middle, _) = self.tiles, self.tile_counts
        in_lower = numbers_of(tiles.lower_mask, lower, slots_at(coords, 4, 3))
        in_upper = numbers_of(tiles.upper_mask, upper, slots_at(coords, 5, 7))
        in_root = tiles_at(root_keys(tiles.root_origin), root_keys(coords), coords)
        starts = self.m, self.m + small, self.m + small + middle
        for found, start in zip((in_lower, in_upper, in_root), starts, strict=True):
            rows = np.where(found < 0, rows, found + start)
        return rows

    # -- other trees -------------------------------------------------------------------------------------------
    def in_order(self) -> tuple[VdbTopology, Ints | None]:
        """The same tree with sorted root tiles.

        Also returns (count,): the index here of each of its values; None if nothing moves. Other programs store the
        root tiles in any order. The masks must be consistent.
        """
        tiles = self.tiles or no_tiles(self.upper_mask, self.lower_mask)
        upper, root = (np.argsort(root_keys(o), kind="stable") for o in (self.root_origin, tiles.root_origin))
        if not (np.diff(upper) < 0).any() and not (np.diff(root) < 0).any():
            return self, None
        lower = rows_of_runs(popcount(self.upper_mask), upper)
        leaf = rows_of_runs(popcount(self.lower_mask), lower)
        small, middle, _ = self.tile_counts
        rows = [
            rows_of_runs(popcount(self.leaf_mask), leaf),
            rows_of_runs(popcount(tiles.lower_mask), lower) + self.m,
            rows_of_runs(popcount(tiles.upper_mask), upper) + self.m + small,
            root + self.m + small + middle,
        ]
        sorted_tiles = VdbTiles(tiles.lower_mask[lower], tiles.upper_mask[upper], tiles.root_origin[root])
        masks = self.upper_mask[upper], self.lower_mask[lower], self.leaf_mask[leaf]
        return VdbTopology(self.root_origin[upper], *masks, sorted_tiles), np.concatenate(rows)

    def only(self, keep: npt.NDArray[np.bool_]) -> VdbTopology:
        """The same nodes, possibly empty, with a selection of the voxels and tiles: keep is (count,)."""
        leaf_mask = bits_kept(self.leaf_mask, keep[: self.m])
        tiles = None
        if self.tiles:
            small, middle, large = np.split(keep[self.m :], np.cumsum(self.tile_counts)[:2])
            lower, upper = bits_kept(self.tiles.lower_mask, small), bits_kept(self.tiles.upper_mask, middle)
            tiles = VdbTiles(lower, upper, self.tiles.root_origin[large])
        return VdbTopology(self.root_origin, self.upper_mask, self.lower_mask, leaf_mask, tiles)

    def same_as(self, other: VdbTopology) -> bool:
        """Whether the same voxels and tiles have values."""
        if self is other:
            return True
        names = ("root_origin", "upper_mask", "lower_mask", "leaf_mask")
        if not all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names):
            return False
        if self.tiles is None or other.tiles is None:
            return self.tiles is other.tiles
        tiles = self.tiles, other.tiles
        return all(np.array_equal(*(getattr(each, name) for each in tiles)) for name in names[:3])

    # -- soundness ---------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        """Masks with inconsistent numbers of nodes, and root tiles out of order."""
        keys = root_keys(self.root_origin)
        astray = np.asarray(np.mod(self.root_origin, 4096) != 0)
        problems = count_problem("root_origin", astray, self.root_origin, "multiples of 4096")
        if (np.diff(keys) <= 0).any():
            problems.append(Problem("root_origin", "is out of order", "tiles sorted by key, each once"))
        return problems + self._tile_problems(keys) + self.mask_problems()

    def _tile_problems(self, keys: Ints) -> list[Problem]:
        if self.tiles is None:
            return []
        own, problems = root_keys(self.tiles.root_origin), []
        if np.mod(self.tiles.root_origin, 4096).any() or (np.diff(own) <= 0).any() or np.isin(own, keys).any():
            problems.append(Problem("root tiles", "overlap or are misaligned", "multiples of 4096, each place once"))
        for name in ("upper_mask", "lower_mask"):
            if (getattr(self, name) & getattr(self.tiles, name)).any():
                problems.append(Problem(name, "has slots that are child and tile at once", "one of them"))
        return problems

    def mask_problems(self) -> list[Problem]:
        """Masks with inconsistent numbers of nodes."""
        problems = []
        for name, above, below in (("upper_mask", "lower", self.lower_mask), ("lower_mask", "leaf", self.leaf_mask)):
            claimed = int(popcount(getattr(self, name)).sum())
            if claimed != len(below):
                found = f"has {plural(claimed, f'{above} node')}"
                problems.append(Problem(name, found, f"{len(below):,}, as many as there are"))
        return problems


def _require_shape(name: str, array: npt.NDArray[Any], width: int, dtype: type[np.generic]) -> None:
    if array.ndim != 2 or array.shape[1] != width or array.dtype != dtype:
        found = f"has shape {array.shape}, dtype {array.dtype}"
        raise InvalidScene(Problem(name, found, f"(any, {width}) {np.dtype(dtype)}"))
