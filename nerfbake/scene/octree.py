"""The sparse voxel octree of TR-24-01 (docs/sources.md): node children and node data, breadth-first."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.octree.lookup import as_points, in_chunks, octree_values
from nerfbake.kernels.octree.walk import Walk, walk
from nerfbake.kernels.soundness import count_problem, plural
from nerfbake.scene.base import Scene, edge_problems, number_problems, place_problems
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.node_rows import NodeData, Rows

_PROVEN = 1 << 15  # rows of node_children at a time: temporaries stay in the cache, and memory bounded
MAX_SIZE = 4096  # voxels along an axis
Layout = Literal["full", "compact"]
Lookup = Literal["nearest", "trilinear"]


def _zeros() -> npt.NDArray[np.float64]:
    return np.zeros(3)


def _ones() -> npt.NDArray[np.float64]:
    return np.ones(3)


@dataclass(frozen=True, eq=False)
class SparseVoxelOctree(Scene):
    """A sparse octree over a grid of W x H x D voxels. Source: docs/formats/octree.md, "Structure".

    size           (W, H, D) voxels along x, y, z; the root's cube is the next power of two
    node_children  (c, 8) int32: row of each child, 0 = none; octant = x + 2y + 4z (1 = the upper half)
    node_data      (n, D) float32 or float16, a row for EVERY node; density sigma (1/world unit) is last. Given as Rows
                   it is made when it is first read; who writes a file takes node_rows, a part at a time
    data_format    scene.basis says how D is laid out; '' if nobody knows
    origin, voxel_size  (3,) float64: world = origin + voxel * voxel_size, voxel (0, 0, 0) starts at origin
    extra_data     the lobes of SG and ASG, else None

    Nodes stand in breadth-first order, so that each level is contiguous and children are numbered 1, 2, 3, ...
    as they are met. c = n is the report's `full` layout; c = nodes above the last level is `compact`.
    A node without any child is a leaf and fills its cube; in a node that has children, an octant without one
    is empty. What an internal node holds is what its level should show (stages.n3tree_to_octree has the rule).

    >>> import numpy as np
    >>> from nerfbake import SparseVoxelOctree
    >>> grey = np.array([[0, 0, 0, 50]], np.float32)
    >>> octree = SparseVoxelOctree((2, 2, 2), np.zeros((1, 8), np.int32), grey, "RGBA")
    >>> octree.sample([[0.5, 1.5, 0.5], [2.5, 0.5, 0.5]])[:, 3]
    array([50.,  0.], dtype=float32)
    """

    size: tuple[int, int, int]
    node_children: npt.NDArray[np.int32]
    node_data: NodeData = NodeData()  # noqa: RUF009 - a descriptor, no default
    data_format: str = ""
    origin: npt.NDArray[np.float64] = field(default_factory=_zeros)
    voxel_size: npt.NDArray[np.float64] = field(default_factory=_ones)
    extra_data: npt.NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        size = tuple(int(edge) for edge in self.size)
        object.__setattr__(self, "size", size)
        if len(size) != 3 or not all(1 <= edge <= MAX_SIZE for edge in size):
            raise InvalidScene(Problem("size", f"is {'x'.join(map(str, size))}", f"1 to {MAX_SIZE} voxels an axis"))
        if self.node_children.ndim != 2 or self.node_children.shape[1] != 8 or self.node_children.dtype != np.int32:
            found = f"has shape {self.node_children.shape}, dtype {self.node_children.dtype}"
            raise InvalidScene(Problem("node_children", found, "(c, 8) int32"))
        shape, dtype = self.node_rows.shape, self.node_rows.dtype
        if len(shape) != 2 or 0 in shape or dtype not in (np.float16, np.float32):
            found = f"has shape {shape}, dtype {dtype}"
            raise InvalidScene(Problem("node_data", found, "(n, D) float16 or float32, n and D at least 1"))
        if self.c > self.n:
            raise InvalidScene(Problem("node_children", f"has {plural(self.c, 'row')}", f"{self.n:,}, one a node"))
        if self.data_format and (dim := parse_basis(self.data_format).data_dim) != self.data_dim:
            found = f"has {self.data_dim} values per node"
            raise InvalidScene(Problem("node_data", found, f"{dim} for data_format {self.data_format}"))
        for name in ("origin", "voxel_size"):
            value = np.broadcast_to(np.asarray(getattr(self, name), np.float64), 3).copy()
            object.__setattr__(self, name, value)

    def __str__(self) -> str:
        size = "x".join(map(str, self.size))
        nodes = f"{plural(self.n, 'node')}, {self.node_rows.dtype}, {self.layout}"
        return f"{self.data_format or 'plain'} octree of {size}, {nodes}"

    # -- sizes -------------------------------------------------------------------------------------------------
    @property
    def node_rows(self) -> Rows:
        """node_data, not made yet perhaps."""
        rows: Rows = self.__dict__["node_rows"]
        return rows

    @property
    def n(self) -> int:
        return int(self.node_rows.shape[0])

    @property
    def c(self) -> int:
        """Nodes that have child slots."""
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
        """(n,) density in 1/world unit; a view."""
        return self.node_data[:, -1]

    @property
    def level_sizes(self) -> list[int]:
        """Nodes in each level, the root's first. Raises InvalidScene if the structure is not sound."""
        self.require_sound()
        return [int(size) for size in np.diff(self._level_ends, prepend=0)]

    @cached_property
    def childless(self) -> npt.NDArray[np.bool_]:
        """(n,) bool: the leaves."""
        childless = np.ones(self.n, bool)
        if self._parents is not None:  # known from the proof of soundness: a tenth of the time
            childless[self._parents] = False
        else:
            childless[: self.c] = ~self.node_children.any(axis=1)
        return childless

    # -- soundness ---------------------------------------------------------------------------------------------
    @cached_property
    def _parents(self) -> npt.NDArray[np.int32] | None:
        """The parents of nodes 1, 2, 3, ... if the nodes stand in breadth-first order, else None.

        In that order the children read 1, 2, ..., n - 1, row by row, each behind its parent: one pass proves a
        table sound.
        """
        memory.require("node_children's order", 4 * self.n)
        parents, met = np.empty(self.n - 1, np.int32), 0
        for start in range(0, self.c, _PROVEN):
            flat = self.node_children[start : start + _PROVEN].reshape(-1)
            slots = np.flatnonzero(flat != 0)  # ten times as fast as flatnonzero(flat)
            own, children, first = start + (slots >> 3), flat[slots], met + 1
            met += len(slots)
            if met >= self.n or (children != np.arange(first, met + 1)).any() or (children <= own).any():
                return None
            parents[first - 1 : met] = own
        return parents if met == self.n - 1 else None

    @cached_property
    def _level_ends(self) -> list[int]:
        """Where each level ends in a table in breadth-first order; at most one level more than the grid has."""
        assert self._parents is not None
        ends = [1]
        while ends[-1] < self.n and len(ends) < self.grid_level + 2:
            # Children are numbered as they are met: a level ends behind the last child of the level above.
            ends.append(1 + int(np.searchsorted(self._parents, np.int32(ends[-1]))))
        return ends

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
        if self._parents is not None:
            levels = len(self._level_ends) - 1
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
        """The same octree in breadth-first order; itself where it is so already, or where its order is not all
        that is wrong with it."""
        if self._parents is not None or self._walk.problems:
            return self
        order = np.concatenate(self._walk.levels)
        if len(order) < self.n:
            return self
        memory.require("nodes in another order", self.node_data.nbytes + 5 * 4 * 8 * self.n)
        table = np.zeros((self.n, 8), np.int32)
        table[: self.c] = self.node_children
        rank = np.zeros(self.n, np.int32)
        rank[order] = np.arange(self.n, dtype=np.int32)
        # The root is row 0 in both orders and nobody's child: rank[0] = 0 keeps "no child" as it is.
        return replace(self, node_children=rank[table[order]], node_data=self.node_data[order])

    def value_problems(self) -> list[Problem]:
        """Values that no renderer can use."""
        problems = number_problems("node_data", self.node_data)
        problems += count_problem("sigma", self.sigma < 0, self.sigma, "a density of 0 or more")
        if self.extra_data is not None:
            problems += number_problems("extra_data", self.extra_data)
        return problems

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

        nearest: the voxel that holds the point. trilinear: the eight voxels whose centres surround it, weighted
        as usual. Empty space and everything outside the W x H x D grid read as zeros.
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
