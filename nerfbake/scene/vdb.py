"""Grids over a VDB tree: values of one or three channels, or a table that is indexed by one topology."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import product
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import as_input
from nerfbake.kernels.octree.lookup import as_points
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.vdb.bitmask import FAR
from nerfbake.scene.base import number_problems
from nerfbake.scene.compact_repr import CompactRepr
from nerfbake.scene.octree import Lookup
from nerfbake.scene.rows import LazyRows, Rows
from nerfbake.scene.vdb_topology import VdbTopology

MOST_DENSE = 16  # largest ratio of leaf voxels to active voxels for which the table is dense
READ_CHUNK = 1 << 14  # points per work item of a core

GridClass = Literal["unknown", "fog volume", "level set", "staggered"]
GRID_CLASSES: tuple[GridClass, ...] = ("unknown", "fog volume", "level set", "staggered")


class TableRows(NamedTuple):
    """The input of kernels.vdb.accessor.

    table: (m + 1, C) float32, row 0 is the background; or, if dense, a row for each voxel of each leaf and of one empty
    leaf.
    """

    dense: bool
    table: npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False, repr=False)
class VdbTree(CompactRepr):
    """A grid of values at voxels and tiles; all other voxels have the background value.

    values (count, c) float32 or float16, c = 1 (a density) or 3 (a colour), in the topology's order
    background (c,) float32
    grid_class  OpenVDB's class of the grid; by default a fog volume for one channel, unknown for three
    active      (count,) bool: False for values of inactive voxels, such as those inside a level set's surface, which
                are minus the background; None if all are active
    place       (3, 4) float64: the grid's own transform, if it differs from the volume's
    stored      how the file stored the values, if their dtype does not tell it: 'double', 'Fp8', ...

    >>> import numpy as np
    >>> from nerfbake import VdbTree
    >>> from nerfbake.scene.vdb_topology import topology_of
    >>> topology, order = topology_of(np.array([[1, 0, 0], [0, 0, 0]]))
    >>> tree = VdbTree("density", topology, np.array([[3], [1]], np.float32)[order], np.zeros(1, np.float32))
    >>> tree.sample([[0.5, 0, 0]], lookup="trilinear")
    array([[2.]], dtype=float32)
    """

    name: str
    topology: VdbTopology
    values: npt.NDArray[Any]
    background: npt.NDArray[np.float32]
    grid_class: GridClass | None = None
    active: npt.NDArray[np.bool_] | None = None
    place: npt.NDArray[np.float64] | None = None
    stored: str = ""

    def __post_init__(self) -> None:
        fits = self.values.ndim == 2 and self.values.shape[1] in (1, 3)
        if not fits or self.values.dtype not in (np.float16, np.float32):
            found = f"has shape {self.values.shape}, dtype {self.values.dtype}"
            raise InvalidScene(Problem(f"grid {self.name!r}", found, "(m, 1 or 3) float16 or float32"))
        if self.background.shape != self.values.shape[1:]:
            found = f"has a background of shape {self.background.shape}"
            raise InvalidScene(Problem(f"grid {self.name!r}", found, f"{self.values.shape[1:]}"))
        if self.grid_class is None:
            object.__setattr__(self, "grid_class", "fog volume" if self.values.shape[1] == 1 else "unknown")
        if self.active is not None:
            if self.active.shape != self.values.shape[:1]:
                found = f"has {len(self.active):,} active states"
                raise InvalidScene(Problem(f"grid {self.name!r}", found, f"{len(self.values):,}, one per value"))
            if self.active.all():
                object.__setattr__(self, "active", None)

    @property
    def dtype(self) -> np.dtype[Any]:
        """The dtype of the values."""
        return self.values.dtype

    @cached_property
    def active_topology(self) -> VdbTopology:
        """The active voxels and tiles alone, over the same nodes."""
        return self.topology if self.active is None else self.topology.only(self.active)

    @property
    def active_values(self) -> npt.NDArray[Any]:
        """The values of active voxels and tiles, in the order of active_topology."""
        return self.values if self.active is None else self.values[self.active]

    def structure_problems(self) -> list[Problem]:
        return self.topology.structure_problems() or _count_problems(self.name, self.topology.count, len(self.values))

    def value_problems(self) -> list[Problem]:
        """Values that cannot be rendered."""
        return number_problems(self.name, self.values) + number_problems("background", self.background)

    @cached_property
    def rows(self) -> TableRows:
        """The values of voxels in leaves, as a table for lookups."""
        table = np.concatenate([self.background[None], self.values[: self.topology.m]], dtype=np.float32)
        return _rows(self.topology, table)

    def sample(self, points: npt.ArrayLike, *, lookup: Lookup = "nearest") -> npt.NDArray[np.float32]:
        """The values at these points: (..., 3) in voxels, centres at integers -> (..., c) float32.

        nearest: the voxel whose centre is nearest (of two the upper one). trilinear: the eight voxels around the point,
        with trilinear weights. A voxel without a value has the background value.
        """
        if self.topology.tiles is None:
            return _sample(self.topology, self.rows, points, lookup)
        return self._sample_tiles(points, lookup)

    def _sample_tiles(self, points: npt.ArrayLike, lookup: Lookup) -> npt.NDArray[np.float32]:
        """sample() for trees with tiles: the masks are searched for every voxel."""
        _require_lookup(lookup)
        array = as_points(points)
        flat = np.clip(np.nan_to_num(array.reshape(-1, 3), nan=FAR), -FAR, FAR)
        table = np.concatenate([self.values, self.background[None]], dtype=np.float32)  # row -1: the background
        if lookup == "nearest":
            out = table[self.topology.rows_at(np.floor(flat + 0.5).astype(np.int64))]
        else:
            low = np.floor(flat)
            part, voxel = (flat - low).astype(np.float32), low.astype(np.int64)
            out = np.zeros((len(flat), table.shape[1]), np.float32)
            for corner in product((0, 1), repeat=3):
                weight = np.prod(np.where(corner, part, 1 - part), axis=1, dtype=np.float32)
                out += weight[:, None] * table[self.topology.rows_at(voxel + corner)]
        return out.reshape(*array.shape[:-1], table.shape[1])


@dataclass(frozen=True, eq=False, repr=False)
class IndexGrid(CompactRepr):
    """One topology for any number of channels: voxel i in the order of VdbTopology has row i + 1 of the table.

    table (m + 1, C) float32 or float16; row 0 is the background. Source: PlenVDB, 4.2 (its M_vdb). If it is given as
    Rows, the array is computed on first access; to write a file, read table_rows in parts.

    >>> from nerfbake import build_octree, build_vdb, sample_n3tree
    >>> (grid,) = build_vdb(build_octree(sample_n3tree(resolution=8)), grids=("index",)).grids
    >>> len(grid.table) == 1 + grid.topology.m
    True
    >>> grid.sample([[3, 3, 1]]).shape
    (1, 28)
    """

    name: str
    topology: VdbTopology
    table: LazyRows = LazyRows("table", "table_rows")  # noqa: RUF009 - a descriptor, no default

    def __post_init__(self) -> None:
        shape, dtype = self.table_rows.shape, self.table_rows.dtype
        if len(shape) != 2 or 0 in shape or dtype not in (np.float16, np.float32):
            found = f"has shape {shape}, dtype {dtype}"
            raise InvalidScene(Problem(f"table of {self.name!r}", found, "(m + 1, C) float16 or float32"))

    @property
    def table_rows(self) -> Rows:
        """The table, possibly not computed yet."""
        rows: Rows = self.__dict__["table_rows"]
        return rows

    @property
    def dtype(self) -> np.dtype[Any]:
        """The dtype of the values."""
        return self.table_rows.dtype

    @property
    def values(self) -> npt.NDArray[Any]:
        """(m, C) the rows of the active voxels, a view."""
        return self.table[1:]

    @property
    def background(self) -> npt.NDArray[np.float32]:
        """(C,) the value of all other voxels."""
        background: npt.NDArray[np.float32] = self.table_rows[:1][0].astype(np.float32)
        return background

    def structure_problems(self) -> list[Problem]:
        if self.topology.tiles is not None:
            return [Problem(f"grid {self.name!r}", "is an index grid with tiles", "an index grid without tiles")]
        return self.topology.structure_problems() or _count_problems(
            self.name, self.topology.m, self.table_rows.shape[0] - 1
        )

    def value_problems(self) -> list[Problem]:
        """Values that cannot be rendered."""
        return number_problems(self.name, self.table)

    @cached_property
    def rows(self) -> TableRows:
        """The table for lookups, in float32; a view if it is float32 already."""
        return TableRows(False, np.ascontiguousarray(self.table, np.float32))

    def sample(self, points: npt.ArrayLike, *, lookup: Lookup = "nearest") -> npt.NDArray[np.float32]:
        """The values at these points: (..., 3) in voxels, centres at integers -> (..., C) float32.

        nearest: the voxel whose centre is nearest (of two the upper one). trilinear: the eight voxels around the point,
        with trilinear weights. Inactive voxels have the background value.
        """
        return _sample(self.topology, self.rows, points, lookup)


def _rows(topology: VdbTopology, table: npt.NDArray[np.float32]) -> TableRows:
    """Return the table in dense form if that is fast and not too large, else unchanged.

    One channel is read faster if each leaf has all of its voxels, as in NanoVDB.
    """
    from nerfbake.kernels.vdb.accessor import dense_leaves

    if table.shape[1] > 1 or 512 * len(topology.leaf_mask) > MOST_DENSE * len(table):
        return TableRows(False, as_input(table))
    return TableRows(True, as_input(dense_leaves(topology.leaf_mask, table)))


def _sample(topology: VdbTopology, rows: TableRows, points: npt.ArrayLike, lookup: Lookup) -> npt.NDArray[np.float32]:
    # Imported on first use: numba takes half a second, and only lookups need it.
    from nerfbake.kernels.vdb.accessor import nearest, trilinear

    _require_lookup(lookup)
    array = as_points(points)
    flat = np.ascontiguousarray(array).reshape(-1, 3)
    out = np.empty((len(flat), rows.table.shape[1]), np.float32)
    read = nearest if lookup == "nearest" else trilinear

    def work(begin: int, end: int) -> None:
        read(topology.tables, *rows, flat[begin:end], out[begin:end])

    over_chunks(work, len(flat), READ_CHUNK)
    return out.reshape(*array.shape[:-1], out.shape[1])


def _require_lookup(lookup: str) -> None:
    if lookup not in ("nearest", "trilinear"):
        raise InvalidScene(Problem("lookup", f"is {lookup!r}", "nearest, trilinear"))


def _count_problems(name: str, count: int, rows: int) -> list[Problem]:
    return [] if count == rows else [Problem(f"grid {name!r}", f"has {rows:,} values", f"{count:,}, one per voxel")]
