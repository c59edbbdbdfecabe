"""The PlenOctree as svox stores it: a table of nodes with N^3 cells each, and children as relative offsets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.octree.lookup import as_points, in_chunks, n3tree_cells
from nerfbake.kernels.octree.walk import Walk, walk
from nerfbake.kernels.soundness import place, plural
from nerfbake.scene.base import Scene, edge_problems, number_problems, place_problems, set_vectors
from nerfbake.scene.basis import parse_basis
from nerfbake.scene.held_out import HeldOut

MAX_SHELLS = 8  # with the inner cube
MAX_CELLS_PER_AXIS = 1 << 20  # cells along an axis at the deepest level: coordinates stay exact in int64


@dataclass(frozen=True, eq=False, repr=False)
class N3Tree(Scene):
    """A sparse N^3 tree over the cube [0, 1]^3. Source: docs/formats/n3tree.md, "Keys"; svox.

    child    (n, N, N, N) int32: offset of the child's row from this row, 0 = leaf; cells are [x][y][z]
    data     (n, N, N, N, D) float16 or float32: a row for EVERY cell; only the rows of leaves are used
    offset, invradius  (3,) float64: world to tree, p = world * invradius + offset
    data_format  'SH9', 'RGBA', 'SG25', ...: scene.basis defines the layout of D; sigma (1/world unit) is last
    extra_data   the lobes of SG and ASG (B, 4 or 11) float32, else None
    dialect  variant of the file format: 'svox', 'legacy', 'quantised', 'quantised+retained'
    held_out held-out pixels, with which compress_octree() measures its loss; None: unknown
    ndc      True for a forward-facing scene, whose cube is not a box of the world
    shells   of a scene with scenery, N = 2: the inner cube is the middle 1 / 2^(shells - 1) of the edge; else 1
    notes    what differs from a file of another program, one line each

    Rows that are not reachable from the root (freed ones) are invalid and never read.

    >>> from nerfbake import sample_n3tree
    >>> tree = sample_n3tree(resolution=8)
    >>> tree.child.shape[1:], tree.data.shape[1:], tree.data_format
    ((2, 2, 2), (2, 2, 2, 28), 'SH9')
    >>> tree.sample([[0.0, 0.0, 0.1], [9.0, 9.0, 9.0]]).shape
    (2, 28)
    """

    child: npt.NDArray[np.int32]
    data: npt.NDArray[Any]
    offset: npt.NDArray[np.float64]
    invradius: npt.NDArray[np.float64]
    data_format: str
    extra_data: npt.NDArray[np.float32] | None = None
    dialect: str = "svox"
    ndc: bool = False
    held_out: HeldOut | None = None
    shells: int = 1
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        shape = self.child.shape
        if self.child.ndim != 4 or shape[0] < 1 or len(set(shape[1:])) != 1 or not 2 <= shape[1] <= 64:
            raise InvalidScene(Problem("child", f"has shape {shape}", "(n, N, N, N) with n >= 1, N = 2 to 64"))
        if self.child.dtype != np.int32:
            raise InvalidScene(Problem("child", f"has dtype {self.child.dtype}", "int32"))
        if self.data.shape[:-1] != shape or self.data.ndim != 5:
            raise InvalidScene(
                Problem("data", f"has shape {self.data.shape}", f"{(*shape, 'D')} with the shape of child")
            )
        if self.data.dtype not in (np.float16, np.float32):
            raise InvalidScene(Problem("data", f"has dtype {self.data.dtype}", "float16 or float32"))
        basis = parse_basis(self.data_format)
        if self.data_dim != basis.data_dim:
            found = f"has {self.data_dim} values per cell"
            raise InvalidScene(Problem("data", found, f"{basis.data_dim} for data_format {self.data_format}"))
        if not 1 <= self.shells <= (MAX_SHELLS if shape[1] == 2 else 1):
            raise InvalidScene(Problem("shells", f"are {self.shells}", f"1 to {MAX_SHELLS}, and 1 unless N is 2"))
        set_vectors(self, "offset", "invradius")

    def __str__(self) -> str:
        nodes = plural(sum(map(len, self.levels)), "node")
        if self.shells == 1:
            return f"{self.data_format} PlenOctree of {self.resolution}^3, {nodes}"
        inner, around = self.resolution >> (self.shells - 1), plural(self.shells - 1, "shell")
        return f"{self.data_format} PlenOctree of {inner}^3 with {around} around it, {nodes}"

    # -- sizes -------------------------------------------------------------------------------------------------
    @property
    def N(self) -> int:
        """Cells of a node along each axis."""
        return int(self.child.shape[1])

    @property
    def n(self) -> int:
        """Rows of the table, including freed ones."""
        return int(self.child.shape[0])

    @property
    def data_dim(self) -> int:
        return int(self.data.shape[-1])

    @cached_property
    def _walk(self) -> Walk:
        flat = self.child.reshape(self.n, -1)

        def targets(rows: npt.NDArray[np.int64]) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
            offsets = flat.take(rows, axis=0).reshape(-1)
            where = np.flatnonzero(offsets != 0)
            return where, offsets[where] + rows[where // flat.shape[1]]

        max_levels = 1
        while self.N ** (max_levels + 1) <= MAX_CELLS_PER_AXIS:
            max_levels += 1
        shape = (self.N,) * 3
        return walk(self.n, targets, shape=shape, name="child", max_levels=max_levels, later=True)

    @property
    def levels(self) -> list[npt.NDArray[np.int64]]:
        """Rows of the live nodes by depth, breadth-first. Raises InvalidScene if the table is not a tree."""
        self.require_sound()
        return self._walk.levels

    @property
    def parent_cells(self) -> list[npt.NDArray[np.int64]]:
        """For each node in `levels`, the flat cell (row * N^3 + cell) that points to it; -1 for the root."""
        self.require_sound()
        return self._walk.cells

    @property
    def resolution(self) -> int:
        """Cells along an axis at the deepest level."""
        return int(self.N ** len(self.levels))

    @property
    def leaf_mask(self) -> npt.NDArray[np.bool_]:
        """(n, N, N, N) bool: the cells whose values are used, that is leaves of live nodes."""
        live = np.zeros(self.n, bool)
        for rows in self.levels:
            live[rows] = True
        mask: npt.NDArray[np.bool_] = (self.child == 0) & live[:, None, None, None]
        return mask

    @property
    def sigma(self) -> npt.NDArray[np.float32]:
        """(n, N, N, N) density in 1/world unit, a copy; only the values of leaves are valid."""
        return np.ascontiguousarray(self.data[..., -1], np.float32)

    def inner_cube(self) -> N3Tree:
        """Return the inner cube of a scene with scenery as a tree of its own; any other tree is returned unchanged.

        The held-out pixels are left out, since they show the scenery, too.
        """
        if self.shells == 1:
            return self
        self.require_sound()
        child = self.child.reshape(self.n, 8)
        # Octant o of the inner cube lies in octant o of the root, and there in cell 7 - o of each shell.
        rows, cells = np.zeros(8, np.int64), np.arange(8)
        held = np.ones(8, bool)
        for _ in range(self.shells - 1):
            step = child[rows, cells].astype(np.int64)
            held &= step != 0
            rows, cells = np.where(held, rows + step, 0), 7 - np.arange(8)
        below = held & (child[rows, cells] != 0)
        nodes = [rows[below] + child[rows, cells][below]]
        while nodes[-1].size:
            steps = child[nodes[-1]]
            nodes.append((nodes[-1][:, None] + steps)[steps != 0])
        kept = np.sort(np.concatenate(nodes))
        number = np.zeros(self.n, np.int64)
        number[kept] = 1 + np.arange(len(kept))
        own = child[kept]
        made = np.zeros((1 + len(kept), 8), np.int32)
        made[0, below] = number[rows[below] + child[rows, cells][below]]
        linked = np.where(own != 0, number[np.minimum(kept[:, None] + own, self.n - 1)] - number[kept][:, None], 0)
        made[1:] = linked
        data = np.zeros((1 + len(kept), 8, self.data_dim), self.data.dtype)
        values = self.data.reshape(self.n, 8, self.data_dim)
        data[0, held] = values[rows, cells][held]
        data[1:] = values[kept]
        scale = 2.0 ** (self.shells - 1)
        return N3Tree(
            child=made.reshape(-1, 2, 2, 2),
            data=data.reshape(-1, 2, 2, 2, self.data_dim),
            offset=(self.offset - 0.5) * scale + 0.5,
            invradius=self.invradius * scale,
            data_format=self.data_format,
            extra_data=self.extra_data,
            dialect=self.dialect,
        )

    # -- soundness ---------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        return [
            *edge_problems("invradius", self.invradius),
            *place_problems("offset", self.offset),
            *(self._walk.problems or self._shell_problems()),
        ]

    def _shell_problems(self) -> list[Problem]:
        levels = len(self._walk.levels)
        if self.shells < max(levels, 2):
            return []
        return [Problem("shells", f"are {self.shells} in {plural(levels, 'level')}", "fewer than its levels")]

    def value_problems(self, *, negative_is_empty: bool = False) -> list[Problem]:
        """Values that cannot be rendered. Only live leaves are checked. The structure must be valid."""
        leaf, sigma, problems = self.leaf_mask, self.sigma, []
        problems += number_problems("data", self.data, where=leaf[..., None])
        negative = leaf & (sigma < 0)
        if negative.any() and not negative_is_empty:
            first = np.unravel_index(int(np.argmax(negative)), negative.shape)
            where = place("data", (*first, self.data_dim - 1))
            allowed = "a density of 0 or more (`svo --sigma-min 0` reads less as empty)"
            problems.append(Problem(where, f"is {sigma[first]:g}", allowed, int(negative.sum())))
        if self.extra_data is not None:
            problems += number_problems("extra_data", self.extra_data)
        return problems

    # -- reading -----------------------------------------------------------------------------------------------
    def sample(self, points: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """The values of the leaves that contain these points: (..., 3) world coordinates -> (..., D) float32.

        A point on a boundary belongs to the upper cell. Points up to 1e-12 of the cube's edge length below a boundary
        count as on it, so that the rounding of a world coordinate does not select the cell. Empty leaves (sigma <= 0)
        and points outside the cube return zeros.
        """
        tree_points = as_points(points) * self.invradius + self.offset
        flat_child, levels = self.child.reshape(self.n, -1), len(self.levels)
        flat_data = self.data.reshape(-1, self.data_dim)

        def read(chunk: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
            cells = n3tree_cells(flat_child, self.N, levels, chunk)
            values = flat_data[np.maximum(cells, 0)].astype(np.float32)
            values[(cells < 0) | ~(values[:, -1] > 0)] = 0
            return values

        return in_chunks(read, tree_points, self.data_dim)
