"""The sparse voxel octree of TR-24-01 (docs/sources.md): node children and node data, breadth-first."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Indices, Points
from nerfbake.kernels.octree.lookup import as_points, in_chunks, octree_values
from nerfbake.kernels.octree.walk import Walk, walk
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.soundness import all_finite, count_problem, plural
from nerfbake.scene.base import Scene, edge_problems, number_problems, place_problems, set_vectors
from nerfbake.scene.basis import parse_basis, voxel_dtype
from nerfbake.scene.rows import LazyRows, RowsOfNodes

_PROVEN = 1 << 15  # rows at a time: temporaries stay in the cache, and memory is bounded
MAX_SIZE = 4096  # voxels along an axis
Layout = Literal["full", "compact"]
Lookup = Literal["nearest", "trilinear"]


class _Order(NamedTuple):
    """The leaves (n,) of nodes in breadth-first order, and where each level ends.

    `ends` has at most one level more than the grid allows, which shows that there are too many.
    """

    childless: npt.NDArray[np.bool_]
    ends: list[int]


def whole_size(size: Sequence[int]) -> tuple[int, int, int]:
    """Return the voxels along each axis. Raises InvalidScene if they are out of range."""
    edges = tuple(int(edge) for edge in size)
    if len(edges) != 3 or not all(1 <= edge <= MAX_SIZE for edge in edges):
        raise InvalidScene(Problem("size", f"is {'x'.join(map(str, edges))}", f"1 to {MAX_SIZE} voxels an axis"))
    return edges


@dataclass(frozen=True, eq=False, repr=False)
class SparseVoxelOctree(Scene):
    """A sparse octree over a grid of W x H x D voxels. Source: docs/formats/octree.md, "Structure".

    size           (W, H, D) voxels along x, y, z; the root's cube is the next power of two
    node_children  (c, 8) int32: row of each child, 0 = none; octant = x + 2y + 4z (1 = the upper half)
    node_data      (n, D) float32 or float16, a row for EVERY node; density sigma (1/world unit) is last. If it is given
                   as Rows, the array is computed on first access; to write a file, read node_rows in parts
    data_format    scene.basis defines the layout of D; '' if unknown
    origin, voxel_size  (3,) float64: world = origin + voxel * voxel_size, voxel (0, 0, 0) starts at origin
    extra_data     the lobes of SG and ASG, (B, 4 or 11), else None; one row is reshaped to (B, -1)

    Nodes are in breadth-first order: each level is contiguous, and children are numbered 1, 2, 3, ... in the order of
    traversal. c = n is the report's `full` layout; c = nodes above the last level is `compact`. A node without any
    child is a leaf and fills its cube. In a node that has children, an octant without a child is empty. An internal
    node stores the values for its level of detail (stages.n3tree_to_octree defines them).

    >>> import numpy as np
    >>> from nerfbake import SparseVoxelOctree
    >>> grey = np.array([[0, 0, 0, 50]], np.float32)
    >>> octree = SparseVoxelOctree((2, 2, 2), np.zeros((1, 8), np.int32), grey, "RGBA")
    >>> octree.sample([[0.5, 1.5, 0.5], [2.5, 0.5, 0.5]])[:, 3]
    array([50.,  0.], dtype=float32)
    """

    size: tuple[int, int, int]
    node_children: npt.NDArray[np.int32]
    node_data: LazyRows = LazyRows("node_data", "node_rows")  # noqa: RUF009 - a descriptor, no default
    data_format: str = ""
    origin: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros(3))
    voxel_size: npt.NDArray[np.float64] = field(default_factory=lambda: np.ones(3))
    extra_data: npt.NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        size = whole_size(self.size)
        object.__setattr__(self, "size", size)
        if self.node_children.ndim != 2 or self.node_children.shape[1] != 8 or self.node_children.dtype != np.int32:
            found = f"has shape {self.node_children.shape}, dtype {self.node_children.dtype}"
            raise InvalidScene(Problem("node_children", found, "(c, 8) int32"))
        shape, dtype = self.node_rows.shape, self.node_rows.dtype
        if len(shape) != 2 or 0 in shape or dtype not in (np.float16, np.float32):
            found = f"has shape {shape}, dtype {dtype}"
            raise InvalidScene(Problem("node_data", found, "(n, D) float16 or float32, n and D at least 1"))
        if self.c > self.n:
            raise InvalidScene(Problem("node_children", f"has {plural(self.c, 'row')}", f"{self.n:,}, one per node"))
        if self.data_format and (dim := parse_basis(self.data_format).data_dim) != self.data_dim:
            found = f"has {self.data_dim} values per node"
            raise InvalidScene(Problem("node_data", found, f"{dim} for data_format {self.data_format}"))
        if self.extra_data is not None and self.extra_data.ndim == 1 and self.data_format:
            # Files that do not store its shape return one row per lobe, so use that shape from the start.
            B, count = parse_basis(self.data_format).size, self.extra_data.size
            if count % B:
                raise InvalidScene(Problem("extra_data", f"has {count:,} numbers", f"a multiple of {B}"))
            object.__setattr__(self, "extra_data", self.extra_data.reshape(B, -1))
        set_vectors(self, "origin", "voxel_size")

    def __str__(self) -> str:
        size = "x".join(map(str, self.size))
        nodes = f"{plural(self.n, 'node')}, {self.node_rows.dtype}, {self.layout}"
        return f"{self.data_format or 'plain'} octree of {size}, {nodes}"

    # -- sizes -------------------------------------------------------------------------------------------------
    @property
    def node_rows(self) -> RowsOfNodes:
        """node_data, possibly not computed yet."""
        rows: RowsOfNodes = self.__dict__["node_rows"]
        return rows

    @property
    def n(self) -> int:
        return int(self.node_rows.shape[0])

    @property
    def c(self) -> int:
        """Number of nodes that have child slots."""
        return int(self.node_children.shape[0])

    @property
    def data_dim(self) -> int:
        return int(self.node_rows.shape[1])

    @property
    def layout(self) -> Layout:
        return "full" if self.c == self.n else "compact"

    @property
    def grid_level(self) -> int:
        """The level whose nodes are single voxels: log2 of the root cube's edge."""
        return max(edge - 1 for edge in self.size).bit_length()

    @property
    def sigma(self) -> npt.NDArray[Any]:
        """(n,) density in 1/world unit; a view if the rows are an array."""
        rows = self.node_rows
        if isinstance(rows, np.ndarray):
            return rows[:, -1]
        sigma = np.empty(self.n, rows.dtype)
        for start in range(0, self.n, _PROVEN):
            sigma[start : start + _PROVEN] = rows[start : start + _PROVEN][:, -1]
        sigma.flags.writeable = False  # a change would be lost
        return sigma

    @property
    def voxels(self) -> npt.NDArray[Any]:
        """(n,) node_data with named fields, a view.

        `voxels["red"]["f1_m1"]` is red's coefficient f1^-1, `voxels["sigma"]` the density. The colours of RGBA are
        single numbers. Raises InvalidScene if the data format is unknown. Source: TR-24-01 (docs/sources.md), 5.1.
        """
        if not self.data_format:
            raise InvalidScene(
                Problem("data_format", "is not known", "SHk, SGk, ASGk or RGBA, whose values have names")
            )
        rows = np.ascontiguousarray(self.node_data)
        return rows.view(voxel_dtype(parse_basis(self.data_format), rows.dtype)).reshape(self.n)

    @property
    def level_sizes(self) -> list[int]:
        """Nodes in each level, the root's first. Raises InvalidScene if the structure is invalid."""
        self.require_sound()
        assert self._order is not None
        return [int(size) for size in np.diff(self._order.ends, prepend=0)]

    @cached_property
    def childless(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: the leaves."""
        if self._order is not None:  # computed by the structure check: ten times as fast
            return self._order.childless
        childless = np.ones(self.n, bool)
        childless[: self.c] = ~self.node_children.any(axis=1)
        return childless

    def leaf_values(self, rows: Indices) -> npt.NDArray[np.float32]:
        """The values (m, D) of the leaves in these rows; node_data is not computed for them."""
        data = self.node_rows
        if isinstance(data, np.ndarray):
            return data[rows].astype(np.float32, copy=False)
        memory.require("the values of the leaves", 4 * len(rows) * self.data_dim)
        values = np.empty((len(rows), self.data_dim), np.float32)

        def copy(begin: int, end: int) -> None:
            values[begin:end] = data.take(rows[begin:end], axis=0)

        over_chunks(copy, len(rows), _PROVEN)
        return values

    # -- soundness ---------------------------------------------------------------------------------------------
    @cached_property
    def _order(self) -> _Order | None:
        """Leaves and levels from one pass over the table; None if the nodes are not in breadth-first order.

        In that order the children read 1, 2, ..., n - 1, row by row, each after its parent. The table is then valid.
        """
        memory.require("node_children's order", self.n)
        childless, ends, met = np.ones(self.n, bool), [1], 0
        for start in range(0, self.c, _PROVEN):
            rows = self.node_children[start : start + _PROVEN]
            flat = rows.reshape(-1)
            slots = np.flatnonzero(flat != 0)  # ten times as fast as flatnonzero(flat)
            own, children, before = start + (slots >> 3), flat[slots], met
            met += len(slots)
            if met >= self.n or (children != np.arange(before + 1, met + 1)).any() or (children <= own).any():
                return None
            childless[own] = False
            while ends[-1] < self.n and ends[-1] <= start + len(rows) and len(ends) < self.grid_level + 2:
                # Children are numbered in order of traversal: a level ends after the last child of the level above.
                ends.append(1 + before + int(np.searchsorted(own, ends[-1])))
        return _Order(childless, ends) if met == self.n - 1 else None

    @cached_property
    def _walk(self) -> Walk:
        table = np.zeros((self.n, 8), np.int32)
        table[: self.c] = self.node_children

        def targets(rows: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
            numbers = table.take(rows, axis=0).reshape(-1)
            where = np.flatnonzero(numbers != 0)
            return where, numbers[where].astype(np.int64)

        return walk(self.n, targets, shape=(8,), name="node_children", max_levels=self.grid_level + 1, later=False)

    def structure_problems(self) -> list[Problem]:
        world = place_problems("origin", self.origin) + edge_problems("voxel_size", self.voxel_size)
        return world + self._table_problems()

    def _table_problems(self) -> list[Problem]:
        if self._order is not None:
            levels = len(self._order.ends) - 1
            size = "x".join(map(str, self.size))
            allowed = f"{self.grid_level} for {size} voxels"
            found = f"has {levels} or more levels below the root"
            return [Problem("node_children", found, allowed)] if levels > self.grid_level else []
        reached = sum(map(len, self._walk.levels))
        if self._walk.problems:
            return self._walk.problems
        if reached < self.n:
            found = f"leads to {reached:,} of {plural(self.n, 'node')}"
            return [Problem("node_children", found, "a way from the root to every node")]
        return [Problem("node_children", "is not in breadth-first order", "children numbered 1, 2, 3, ... as met")]

    def breadth_first(self) -> SparseVoxelOctree:
        """The same octree in breadth-first order.

        Returns the octree itself if it is in this order already, or if it has other structural problems.
        """
        if self._order is not None:
            return self
        memory.require("the order of the nodes", 56 * self.n)
        if self._walk.problems:
            return self
        order = np.concatenate(self._walk.levels)
        if len(order) < self.n:
            return self
        memory.require("nodes in another order", self.node_data.nbytes + 5 * 4 * 8 * self.n)
        table = np.zeros((self.n, 8), np.int32)
        table[: self.c] = self.node_children
        rank = np.zeros(self.n, np.int32)
        rank[order] = np.arange(self.n, dtype=np.int32)
        # The root is row 0 in both orders and never a child: rank[0] = 0 leaves "no child" unchanged.
        return replace(self, node_children=rank[table[order]], node_data=self.node_data[order])

    def value_problems(self) -> list[Problem]:
        """Values that cannot be rendered."""
        problems = [] if self._usable_rows() else self._row_problems()
        if self.extra_data is not None:
            problems += number_problems("extra_data", self.extra_data)
        return problems

    def _usable_rows(self) -> bool:
        """Whether all values can be rendered; checked in parts."""
        rows = self.node_rows
        for start in range(0, self.n, _PROVEN):
            some = rows[start : start + _PROVEN]
            if not all_finite(some) or (some[:, -1] < 0).any():
                return False
        return True

    def _row_problems(self) -> list[Problem]:
        problems = number_problems("node_data", self.node_data)
        return problems + count_problem("sigma", self.sigma < 0, self.sigma, "a density of 0 or more")

    # -- layouts -----------------------------------------------------------------------------------------------
    def with_layout(self, layout: Layout) -> SparseVoxelOctree:
        """The same octree with child slots for every node (`full`) or for those above the last level (`compact`)."""
        keep = self.n if layout == "full" else self.n - self.level_sizes[-1]
        if keep == self.c:
            return self
        children = np.zeros((keep, 8), np.int32)
        children[: self.c] = self.node_children[:keep]
        return replace(self, node_children=children)

    # -- reading -----------------------------------------------------------------------------------------------
    def sample(self, points: npt.ArrayLike, *, lookup: Lookup = "nearest") -> npt.NDArray[np.float32]:
        """The values at these points: (..., 3) world coordinates -> (..., D) float32.

        nearest: the voxel that contains the point. trilinear: the eight voxels whose centres surround it, with
        trilinear weights. Empty space and points outside the W x H x D grid return zeros.
        """
        if lookup not in ("nearest", "trilinear"):
            raise InvalidScene(Problem("lookup", f"is {lookup!r}", "nearest, trilinear"))
        self.require_sound()
        voxel_points = (as_points(points) - self.origin) / self.voxel_size
        table, level = (self.node_children, self.childless, self.node_data), self.grid_level
        corners = 1 if lookup == "nearest" else 2

        def read(points: Points) -> npt.NDArray[np.float32]:
            return octree_values(*table, level, self.size, points, corners)

        return in_chunks(read, voxel_points, self.data_dim)
