"""The VDB tree, 5-4-3: a root of 4096^3 tiles, upper nodes of 32^3, lower nodes of 16^3, leaves of 8^3 voxels.

Slots are x-major. Of the voxel (x, y, z), from the leaf up:

    voxel in leaf     (x & 7) << 6        | (y & 7) << 3        | z & 7
    leaf in lower     (x >> 3 & 15) << 8  | (y >> 3 & 15) << 4  | z >> 3 & 15
    lower in upper    (x >> 7 & 31) << 10 | (y >> 7 & 31) << 5  | z >> 7 & 31
    tile in root      (x >> 12) << 42     | (y >> 12) << 21     | z >> 12, each cut to 20 bits

Sorting by all of these in turn puts every level into breadth-first order, so that masks alone say which node is whose
child: no offsets, no origins but the root's. Source: spec/vdb.md, 1; PlenVDB (Yan et al., 2023), 4.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.bitmask import Ints, Words, exclusive_sum, group_bits, popcount, slots_of
from nerfbake.kernels.lookup import as_points
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.runs import rows_of_runs
from nerfbake.kernels.topology import all_finite, count_problem, plural
from nerfbake.scene.octree import Lookup

LEAF_BITS, LOWER_BITS, UPPER_BITS = 9, 12, 15
ROOT_BITS = 20  # of a tile's number along an axis
MOST_DENSE = 16  # a leaf's voxels for each active one, up to which all of them are kept to be read
CHUNK = 1 << 14  # points that a core reads in one go
Coords = npt.NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class VdbTopology:
    """Which voxels are active.

    root_origin (u, 3) int32   lowest voxel of each upper node, multiples of 4096, in the order of root_keys()
    upper_mask  (u, 512) uint64  the lower nodes that each upper node has
    lower_mask  (k, 64) uint64   the leaves that each lower node has
    leaf_mask   (l, 8) uint64    the active voxels of each leaf; m of them altogether
    """

    root_origin: Coords
    upper_mask: Words
    lower_mask: Words
    leaf_mask: Words

    def __post_init__(self) -> None:
        masks = {"upper_mask": 512, "lower_mask": 64, "leaf_mask": 8}
        for name, width, dtype in [("root_origin", 3, np.int32), *((name, masks[name], np.uint64) for name in masks)]:
            array = getattr(self, name)
            if array.ndim != 2 or array.shape[1] != width or array.dtype != dtype:
                found = f"has shape {array.shape}, dtype {array.dtype}"
                raise InvalidScene(Problem(name, found, f"(any, {width}) {np.dtype(dtype)}"))
        if len(self.root_origin) != len(self.upper_mask):
            found = f"has {plural(len(self.upper_mask), 'row')}"
            raise InvalidScene(Problem("upper_mask", found, f"{len(self.root_origin):,} as root_origin"))

    @property
    def node_counts(self) -> tuple[int, int, int]:
        """Upper nodes, lower nodes, leaves."""
        return len(self.upper_mask), len(self.lower_mask), len(self.leaf_mask)

    @cached_property
    def m(self) -> int:
        """Active voxels."""
        return int(popcount(self.leaf_mask).sum())

    @cached_property
    def first(self) -> Ints:
        """(l,) the number of each leaf's first voxel."""
        return exclusive_sum(popcount(self.leaf_mask))

    @cached_property
    def lower_origin(self) -> Coords:
        """(k, 3) lowest voxel of each lower node."""
        return _origins(self.root_origin, self.upper_mask, 5, 128)

    @cached_property
    def leaf_origin(self) -> Coords:
        """(l, 3) lowest voxel of each leaf."""
        return _origins(self.lower_origin, self.lower_mask, 4, 8)

    @property
    def coords(self) -> Coords:
        """(m, 3) the active voxels, in order."""
        return _origins(self.leaf_origin, self.leaf_mask, 3, 1)

    @cached_property
    def box(self) -> tuple[Ints, Ints] | None:
        """The lowest and the highest active voxel on each axis, both included; None where there is none."""
        low, high = self.leaf_boxes
        return (low.min(axis=0), high.max(axis=0)) if len(low) else None

    @cached_property
    def leaf_boxes(self) -> tuple[Ints, Ints]:
        """(l, 3) lowest and highest active voxel of each leaf; an empty leaf gives its own whole cube."""
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
        from nerfbake.kernels.accessor import tables_of

        return tables_of(self.root_origin, self.upper_mask, self.lower_mask, self.leaf_mask)

    def in_order(self) -> tuple[VdbTopology, Ints]:
        """The same voxels with the root's tiles sorted, and (l,) the leaf here that each leaf there is.

        Other programs keep the tiles as they like. The masks must agree.
        """
        tiles = np.argsort(root_keys(self.root_origin), kind="stable")
        lowers = rows_of_runs(popcount(self.upper_mask), tiles)
        leaves = rows_of_runs(popcount(self.lower_mask), lowers)
        masks = self.upper_mask[tiles], self.lower_mask[lowers], self.leaf_mask[leaves]
        return VdbTopology(self.root_origin[tiles], *masks), leaves

    def same_as(self, other: VdbTopology) -> bool:
        """Whether the same voxels are active."""
        return self is other or all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("root_origin", "upper_mask", "lower_mask", "leaf_mask")
        )

    def structure_problems(self) -> list[Problem]:
        """Masks that disagree about how many nodes there are, and tiles out of order."""
        keys = root_keys(self.root_origin)
        astray = np.asarray(np.mod(self.root_origin, 4096) != 0)
        problems = count_problem("root_origin", astray, self.root_origin, "multiples of 4096")
        if (np.diff(keys) <= 0).any():
            problems.append(Problem("root_origin", "is out of order", "tiles sorted by key, each once"))
        return problems + self.mask_problems()

    def mask_problems(self) -> list[Problem]:
        """Masks that disagree about how many nodes there are."""
        problems = []
        for name, above, below in (("upper_mask", "lower", self.lower_mask), ("lower_mask", "leaf", self.leaf_mask)):
            claimed = int(popcount(getattr(self, name)).sum())
            if claimed != len(below):
                found = f"has {plural(claimed, f'{above} node')}"
                problems.append(Problem(name, found, f"{len(below):,}, as many as there are"))
        return problems


def root_keys(coords: npt.NDArray[np.integer[Any]]) -> Ints:
    """(m,) the numbers by which root tiles are sorted, those that NanoVDB gives them; coords (m, 3)."""
    x, y, z = (coords[:, axis].astype(np.int64) >> 12 & (1 << ROOT_BITS) - 1 for axis in range(3))
    return x << 42 | y << 21 | z


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


_STEPS = ((5, 7), (4, 3), (3, 0))  # bits of a slot along an axis, and the coordinate's bits below them


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


class Rows(NamedTuple):
    """What kernels.accessor reads: table (m + 1, C) float32, row 0 the background; or, dense, a row for each voxel of
    each leaf and of one that is empty."""

    dense: bool
    table: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class VdbTree:
    """A grid of values at the active voxels; everywhere else it is the background.

    values (m, c) float32 or float16, c = 1 (a density) or 3 (a colour); background (c,) float32.
    """

    name: str
    topology: VdbTopology
    values: npt.NDArray[Any]
    background: npt.NDArray[np.float32]

    def __post_init__(self) -> None:
        fits = self.values.ndim == 2 and self.values.shape[1] in (1, 3)
        if not fits or self.values.dtype not in (np.float16, np.float32):
            found = f"has shape {self.values.shape}, dtype {self.values.dtype}"
            raise InvalidScene(Problem(f"grid {self.name!r}", found, "(m, 1 or 3) float16 or float32"))
        if self.background.shape != self.values.shape[1:]:
            found = f"has a background of shape {self.background.shape}"
            raise InvalidScene(Problem(f"grid {self.name!r}", found, f"{self.values.shape[1:]}"))

    def structure_problems(self) -> list[Problem]:
        return self.topology.structure_problems() or _count_problems(self.name, self.topology.m, len(self.values))

    def value_problems(self) -> list[Problem]:
        """Values that no renderer can use."""
        return _finite_problems(self.name, self.values) + _finite_problems("background", self.background)

    @cached_property
    def rows(self) -> Rows:
        """The values as they are read."""
        table = np.concatenate([self.background[None], self.values], dtype=np.float32)
        return _rows(self.topology, table)

    def sample(self, points: npt.ArrayLike, *, lookup: Lookup = "nearest") -> npt.NDArray[np.float32]:
        """The values at these points: (..., 3) in voxels, centres at whole numbers -> (..., c) float32.

        nearest: the voxel whose centre is nearest (of two the upper one). trilinear: the eight around the point,
        weighted as usual. Inactive voxels read as the background.
        """
        return _sample(self.topology, self.rows, points, lookup)


@dataclass(frozen=True, eq=False)
class IndexGrid:
    """One topology for any number of channels: voxel i of the order of VdbTopology has row i + 1 of the table.

    table (m + 1, C) float32 or float16; row 0 is the background.  Source: PlenVDB, 4.2 (its M_vdb).
    """

    name: str
    topology: VdbTopology
    table: npt.NDArray[Any]

    def __post_init__(self) -> None:
        if self.table.ndim != 2 or not self.table.size or self.table.dtype not in (np.float16, np.float32):
            found = f"has shape {self.table.shape}, dtype {self.table.dtype}"
            raise InvalidScene(Problem(f"table of {self.name!r}", found, "(m + 1, C) float16 or float32"))

    @property
    def values(self) -> npt.NDArray[Any]:
        """(m, C) the rows of the active voxels; a view."""
        return self.table[1:]

    @property
    def background(self) -> npt.NDArray[np.float32]:
        """(C,) what is read everywhere else."""
        background: npt.NDArray[np.float32] = self.table[0].astype(np.float32)
        return background

    def structure_problems(self) -> list[Problem]:
        return self.topology.structure_problems() or _count_problems(self.name, self.topology.m, len(self.values))

    def value_problems(self) -> list[Problem]:
        """Values that no renderer can use."""
        return _finite_problems(self.name, self.table)

    @cached_property
    def rows(self) -> Rows:
        """The table as it is read; itself where it is float32."""
        return Rows(False, np.ascontiguousarray(self.table, np.float32))

    def sample(self, points: npt.ArrayLike, *, lookup: Lookup = "nearest") -> npt.NDArray[np.float32]:
        """The values at these points: (..., 3) in voxels, centres at whole numbers -> (..., C) float32.

        nearest: the voxel whose centre is nearest (of two the upper one). trilinear: the eight around the point,
        weighted as usual. Inactive voxels read as the background.
        """
        return _sample(self.topology, self.rows, points, lookup)


def _rows(topology: VdbTopology, table: npt.NDArray[np.float32]) -> Rows:
    """One channel is read faster where each leaf has all of its voxels, as NanoVDB has them; where that is much more
    than there is, it stays as it is."""
    from nerfbake.kernels.accessor import dense_leaves

    if table.shape[1] > 1 or 512 * len(topology.leaf_mask) > MOST_DENSE * len(table):
        return Rows(False, table)
    return Rows(True, dense_leaves(topology.leaf_mask, table))


def _sample(topology: VdbTopology, rows: Rows, points: npt.ArrayLike, lookup: Lookup) -> npt.NDArray[np.float32]:
    # Imported on first use: numba takes half a second, and only reads need it.
    from nerfbake.kernels.accessor import nearest, trilinear

    if lookup not in ("nearest", "trilinear"):
        raise InvalidScene(Problem("lookup", f"is {lookup!r}", "nearest, trilinear"))
    array = as_points(points)
    flat = np.ascontiguousarray(array).reshape(-1, 3)
    out = np.empty((len(flat), rows.table.shape[1]), np.float32)
    read = nearest if lookup == "nearest" else trilinear

    def work(begin: int, end: int) -> None:
        read(topology.tables, *rows, flat[begin:end], out[begin:end])

    over_chunks(work, len(flat), CHUNK)
    return out.reshape(*array.shape[:-1], out.shape[1])


def _origins(above: Coords, masks: Words, bits: int, width: int) -> Coords:
    row, slot = slots_of(masks)
    low = (1 << bits) - 1
    step = np.stack([slot >> 2 * bits, slot >> bits & low, slot & low], axis=1).astype(np.int32)
    return above[row] + step * np.int32(width)


def _count_problems(name: str, m: int, rows: int) -> list[Problem]:
    return [] if m == rows else [Problem(f"grid {name!r}", f"has {rows:,} values", f"{m:,}, one a voxel")]


def _finite_problems(name: str, values: npt.NDArray[Any]) -> list[Problem]:
    return [] if all_finite(values) else count_problem(name, ~np.isfinite(values), values, "a finite number")
