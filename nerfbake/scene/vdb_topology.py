"""The VDB tree, 5-4-3: a root of 4096^3 tiles, upper nodes of 32^3, lower nodes of 16^3, leaves of 8^3 voxels.

Slots are x-major. Of the voxel (x, y, z), from the leaf up:

    voxel in leaf     (x & 7) << 6        | (y & 7) << 3        | z & 7
    leaf in lower     (x >> 3 & 15) << 8  | (y >> 3 & 15) << 4  | z >> 3 & 15
    lower in upper    (x >> 7 & 31) << 10 | (y >> 7 & 31) << 5  | z >> 7 & 31
    tile in root      (x >> 12) << 42     | (y >> 12) << 21     | z >> 12, each cut to 20 bits

Sorting by all of these in turn puts every level into breadth-first order, so that masks alone say which node is whose
child: no offsets, no origins but the root's. In place of a child a slot may be a tile: a cube that has one value.
Source: docs/formats/vdb.md, "The VDB tree"; PlenVDB (docs/sources.md, "PlenVDB"), section 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Coords, Ints, Words
from nerfbake.kernels.soundness import count_problem, plural
from nerfbake.kernels.vdb.bitmask import bits_kept, exclusive_sum, numbers_of, popcount
from nerfbake.kernels.vdb.runs import rows_of_runs
from nerfbake.kernels.vdb.slots import origins_of, root_keys, slots_at, tiles_at
from nerfbake.scene.vdb_tiles import TILE_EDGES, Cubes, VdbTiles, no_tiles


@dataclass(frozen=True, eq=False)
class VdbTopology:
    """Which voxels, and which tiles, have a value of their own: in nearly all grids those that are active.

    root_origin (u, 3) int32   lowest voxel of each upper node, multiples of 4096, in the order of root_keys()
    upper_mask  (u, 512) uint64  the lower nodes that each upper node has
    lower_mask  (k, 64) uint64   the leaves that each lower node has
    leaf_mask   (l, 8) uint64    the voxels that each leaf has; m of them altogether
    tiles       None where there are none

    Values stand in this order: the voxels, leaf after leaf, then the tiles of 8^3, of 128^3, of 4096^3.
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
            raise InvalidScene(Problem("upper_mask", found, f"{len(self.root_origin):,} as root_origin"))
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
        """Upper nodes, lower nodes, leaves."""
        return len(self.upper_mask), len(self.lower_mask), len(self.leaf_mask)

    @property
    def tile_counts(self) -> tuple[int, int, int]:
        """Tiles of 8^3, of 128^3, of 4096^3."""
        return self.tiles.counts if self.tiles else (0, 0, 0)

    @cached_property
    def m(self) -> int:
        """Voxels in leaves."""
        return int(popcount(self.leaf_mask).sum())

    @property
    def count(self) -> int:
        """Values: of voxels in leaves and of tiles."""
        return self.m + sum(self.tile_counts)

    @property
    def voxel_count(self) -> int:
        """Voxels in leaves and in tiles."""
        return self.m + sum(count * edge**3 for count, edge in zip(self.tile_counts, TILE_EDGES, strict=True))

    # -- places ------------------------------------------------------------------------------------------------
    @cached_property
    def first(self) -> Ints:
        """(l,) the number of each leaf's first voxel."""
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
        """(m, 3) the voxels in leaves, in order."""
        return origins_of(self.leaf_origin, self.leaf_mask, 3, 1)

    @property
    def tile_cubes(self) -> list[Cubes]:
        """The tiles of 8^3, of 128^3, of 4096^3, in order; an empty list where there are none."""
        if self.tiles is None:
            return []
        lower = origins_of(self.lower_origin, self.tiles.lower_mask, 4, 8)
        upper = origins_of(self.root_origin, self.tiles.upper_mask, 5, 128)
        return [Cubes(low, edge) for low, edge in zip((lower, upper, self.tiles.root_origin), TILE_EDGES, strict=True)]

    @cached_property
    def box(self) -> tuple[Ints, Ints] | None:
        """The lowest and the highest voxel on each axis, both included; None where there is none."""
        held = self.leaf_mask.any(axis=1)
        ends = [(low[held], high[held]) for low, high in [self.leaf_boxes]]
        ends += [(low.astype(np.int64), low.astype(np.int64) + edge - 1) for low, edge in self.tile_cubes]
        low, high = (np.concatenate([pair[side] for pair in ends]) for side in (0, 1))
        return (low.min(axis=0), high.max(axis=0)) if len(low) else None

    @cached_property
    def leaf_boxes(self) -> tuple[Ints, Ints]:
        """(l, 3) lowest and highest voxel of each leaf; an empty leaf gives its own whole cube."""
        octets = np.unpackbits(self.leaf_mask.astype("<u8").view(np.uint8).reshape(-1, 64), axis=1, bitorder="little")
        solid = octets.reshape(-1, 8, 8, 8)
        low, high = np.empty((len(solid), 3), np.int64), np.empty((len(solid), 3), np.int64)
        for axis, others in enumerate(((2, 3), (1, 3), (1, 2))):
            used: npt.NDArray[np.bool_] = np.any(solid, axis=others)
            low[:, axis], high[:, axis] = used.argmax(axis=1), 7 - used[:, ::-1].argmax(axis=1)
        return low + self.leaf_origin, high + self.leaf_origin

    @cached_property
    def tables(self) -> Any:
        """The masks with their ranks, for kernels.accessor."""
        from nerfbake.kernels.vdb.accessor import tables_of

        return tables_of(self.root_origin, self.upper_mask, self.lower_mask, self.leaf_mask)

    # -- lookups -----------------------------------------------------------------------------------------------
    def nodes_at(self, coords: npt.NDArray[np.integer[Any]]) -> list[Ints]:
        """The upper node, the lower node and the leaf around each voxel (q, 3): three times (q,), -1 for none."""
        keys, own = root_keys(coords), root_keys(self.root_origin)
        upper = tiles_at(own, keys, coords)
        lower = numbers_of(self.upper_mask, upper, slots_at(coords, 5, 7))
        return [upper, lower, numbers_of(self.lower_mask, lower, slots_at(coords, 4, 3))]

    def rows_at(self, coords: npt.NDArray[np.integer[Any]]) -> Ints:
        """The number of the value that each voxel (q, 3) has, in a leaf or in a tile; -1 where it has none."""
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
        """The same tree with the root's tiles sorted, and (count,) the value here that each value there is; None
        where nothing moves.

        Other programs keep the tiles as they like. The masks must agree.
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
        """The same nodes, which may be empty then, with only some of the voxels and tiles: keep is (count,)."""
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
        """Masks that disagree about how many nodes there are, and tiles out of order."""
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
            problems.append(Problem("root tiles", "overlap or lie astray", "multiples of 4096, each place once"))
        for name in ("upper_mask", "lower_mask"):
            if (getattr(self, name) & getattr(self.tiles, name)).any():
                problems.append(Problem(name, "has slots that are child and tile at once", "one of them"))
        return problems

    def mask_problems(self) -> list[Problem]:
        """Masks that disagree about how many nodes there are."""
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
