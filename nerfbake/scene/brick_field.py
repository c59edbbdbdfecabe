"""The field that is fitted to pictures: bricks of 8^3 cells, in which eight cells may be merged into one wide cell.

A field with scenery has an inner cube, and shells of coarser cells around it. Source: docs/fitting.md, "Scenery".
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Coords, Ints, Points, Singles
from nerfbake.kernels.fit.bricks import top_grid
from nerfbake.kernels.parallel import over_chunks
from nerfbake.kernels.soundness import count_problem, plural
from nerfbake.scene.base import Scene, edge_problems, number_problems, place_problems, require_shape
from nerfbake.scene.basis import Basis, renderable_basis
from nerfbake.scene.n3tree import MAX_SHELLS

EDGE = 8  # cells along an axis of a brick
MAX_RESOLUTION = 4096
MIN_SHELL_BRICKS = 4  # along an axis: then the next smaller shell covers whole bricks
EMPTY = -1
_CHUNK = 1 << 8  # bricks that a core checks at a time


@dataclass(frozen=True, eq=False, repr=False)
class BrickField(Scene):
    """A radiance field over a lattice of cells. Only non-empty bricks of 8^3 cells are stored.

    The lattice may have shells: shell k covers 2^k times the box, with as many cells along an axis, and has no cells
    within shell k - 1. Shell 0 is the inner cube, which is all that an object without scenery has.

    resolution  cells of the inner cube along each axis, a power of two from 8; with shells from 32
    box     (2, 3) float64: lowest and highest corner of the inner cube in the world; cells may be oblong
    basis   SH1 to SH25
    top     (S r, r, r) int32, r = resolution / 8, the grids of S shells one after the other: the number of the brick, 0
            or more, in raster order; -d for an empty place whose nearest brick in the shell is d bricks away along the
            farthest axis (r if there is no brick at all)
    rows    (b, 512) int32: the cells of each brick, x-major (x << 6 | y << 3 | z). -1 is empty, else row << 1 | wide. A
            wide cell covers 2^3 cells of the lattice at an even position, which all store the same number
    values  (n, 3 B + 1) float32: a row for each cell, in order of first occurrence in `rows`: B coefficients of red, of
            green, of blue (the colour is the sigmoid of their sum), then the density per world unit

    >>> import numpy as np
    >>> from nerfbake import BrickField
    >>> from nerfbake.scene.basis import Basis
    >>> top, rows = np.zeros((1, 1, 1), np.int32), np.full((1, 512), -1, np.int32)
    >>> rows[0, 0] = 0
    >>> grey = np.array([[0, 0, 0, 50]], np.float32)
    >>> field = BrickField(8, np.array([[0.0] * 3, [1.0] * 3]), Basis("SH", 1), top, rows, grey)
    >>> print(field)
    SH1 field of 1 cell in 1 brick of 8^3, in a lattice of 8^3
    >>> field.sample(np.array([[0.1, 0.1, 0.1], [0.2, 0.1, 0.1]]))[:, 3]
    array([50.,  0.], dtype=float32)
    """

    resolution: int
    box: Points
    basis: Basis
    top: npt.NDArray[np.int32]
    rows: npt.NDArray[np.int32]
    values: Singles

    def __post_init__(self) -> None:
        if not EDGE <= self.resolution <= MAX_RESOLUTION or self.resolution & (self.resolution - 1):
            allowed = f"a power of two, {EDGE} to {MAX_RESOLUTION}"
            raise InvalidScene(Problem("resolution", f"is {self.resolution}", allowed))
        if renderable_basis(str(self.basis)).kind != "SH":
            raise InvalidScene(Problem("basis", f"is {self.basis}", "SH1, SH4, SH9, SH16, SH25"))
        r = self.resolution // EDGE
        require_shape("the field's box", self.box, (2, 3), np.float64)
        require_shape("the field's top", self.top, (r * self.shells, r, r), np.int32)
        if not 1 <= self.shells <= (MAX_SHELLS if r >= MIN_SHELL_BRICKS else 1):
            allowed = f"1 to {MAX_SHELLS}, and 1 in a lattice of less than {MIN_SHELL_BRICKS * EDGE}^3"
            raise InvalidScene(Problem("the field's shells", f"are {self.shells} in {self.resolution}^3", allowed))
        require_shape("the field's rows", self.rows, (len(self.rows), EDGE**3), np.int32)
        require_shape("the field's values", self.values, (len(self.values), self.basis.data_dim), np.float32)

    def __str__(self) -> str:
        held = f"{plural(self.n, 'cell')} in {plural(self.b, 'brick')}"
        around = f" and {plural(self.shells - 1, 'shell')} around it" if self.shells > 1 else ""
        return f"{self.basis} field of {held} of {EDGE}^3, in a lattice of {self.resolution}^3{around}"

    # -- sizes -------------------------------------------------------------------------------------------------
    @property
    def n(self) -> int:
        """Number of non-empty cells; a wide cell counts once."""
        return len(self.values)

    @property
    def b(self) -> int:
        """Number of bricks."""
        return len(self.rows)

    @property
    def shells(self) -> int:
        """Number of shells, with the inner cube."""
        return max(len(self.top) // max(self.top.shape[1], 1), 1) if self.top.ndim == 3 else 1

    @property
    def cell_size(self) -> Points:
        """(3,) edges of the finest cells of the inner cube in world units."""
        return np.asarray((self.box[1] - self.box[0]) / self.resolution, np.float64)

    # -- shells ------------------------------------------------------------------------------------------------
    def shell_box(self, shell: int) -> Points:
        """(2, 3) lowest and highest corner of a shell in the world."""
        centre, half = self.box.mean(axis=0), (self.box[1] - self.box[0]) / 2 * 2.0**shell
        return np.stack([centre - half, centre + half]) if shell else self.box

    def shell(self, number: int) -> BrickField:
        """Return the cells of one shell as a field of its own; 0 is the inner cube."""
        if self.shells == 1 and number == 0:
            return self
        r = self.top.shape[1]
        top = self.top[number * r : (number + 1) * r]
        before = int(np.count_nonzero(self.top[: number * r] >= 0))
        rows = self.rows[before : before + int(np.count_nonzero(top >= 0))]
        met = rows[rows >= 0] >> 1
        first, last = (int(met.min()), int(met.max()) + 1) if met.size else (0, 0)
        return BrickField(
            self.resolution,
            self.shell_box(number),
            self.basis,
            np.where(top >= 0, top - before, top).astype(np.int32),
            np.where(rows >= 0, rows - 2 * first, rows).astype(np.int32),
            self.values[first:last],
        )

    # -- places ------------------------------------------------------------------------------------------------
    @cached_property
    def brick_corners(self) -> Coords:
        """(b, 3) int32: the lowest cell of each brick, counted from the lowest corner of its shell."""
        return np.asarray(EDGE * (np.argwhere(self.top >= 0) % self.top.shape[1]), np.int32)

    @cached_property
    def corners(self) -> Coords:
        """(n, 3) int32: the lowest lattice cell of each row's cell, counted from the lowest corner of its shell."""
        flat, first = self.rows.reshape(-1), self._first
        brick, cell = first // EDGE**3, first % EDGE**3
        within = np.stack([cell >> 6, cell >> 3 & 7, cell & 7], axis=1)
        assert (flat[first] >= 0).all()
        return (self.brick_corners[brick] + within).astype(np.int32)

    @cached_property
    def wide(self) -> Bits:
        """(n,) bool: the cells that cover 2^3 cells of the lattice."""
        return (self.rows.reshape(-1)[self._first] & 1).astype(bool)

    @cached_property
    def _first(self) -> Ints:
        """(n,) the first index of each row in the flattened `rows`."""
        flat = self.rows.reshape(-1)
        held = np.flatnonzero(flat >= 0)
        numbers = flat[held] >> 1
        first = np.empty(self.n, np.int64)
        first[numbers[::-1]] = held[::-1]
        return first

    # -- reading -----------------------------------------------------------------------------------------------
    def rows_at(self, points: Points) -> Ints:
        """(m,) the row of the cell around each world point (m, 3); -1 in empty space and outside."""
        found, left = np.full(len(points), EMPTY, np.int64), np.ones(len(points), bool)
        r = self.top.shape[1]
        for shell in range(self.shells):
            cells = (points - self.shell_box(shell)[0]) / (self.cell_size * 2.0**shell)
            inside = left & ((cells >= 0) & (cells < self.resolution)).all(axis=1)
            left &= ~inside
            x, y, z = np.where(inside[:, None], cells, 0).astype(np.int64).T
            brick = np.where(inside, self.top[shell * r + (x >> 3), y >> 3, z >> 3], -1)
            at = np.flatnonzero(brick >= 0)
            slots = self.rows[brick[at], (x[at] & 7) << 6 | (y[at] & 7) << 3 | z[at] & 7]
            found[at] = slots >> 1  # -1 (empty) stays -1
        return found

    def sample(self, points: Points) -> Singles:
        """The values (m, 3 B + 1) of the cells around world points (m, 3); zeros in empty space and outside."""
        rows = self.rows_at(points)
        found = np.zeros((len(points), self.basis.data_dim), np.float32)
        found[rows >= 0] = self.values[rows[rows >= 0]]
        return found

    # -- soundness ---------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        """An empty box, bricks or rows that are not numbered in order, incomplete wide cells."""
        world = place_problems("box", self.box)
        world = world or edge_problems("box's edges", self.box[1] - self.box[0])
        return world + (self._brick_problems() or self._row_problems())

    def value_problems(self) -> list[Problem]:
        """Values that cannot be rendered."""
        sigma = self.values[:, -1]
        return number_problems("values", self.values) + count_problem(
            "sigma", sigma < 0, sigma, "a density of 0 or more"
        )

    def _brick_problems(self) -> list[Problem]:
        held = int(np.count_nonzero(self.top >= 0))
        if held != self.b:
            return [Problem("top", f"numbers {plural(held, 'brick')}", f"{self.b:,}, one per row of `rows`")]
        r, wrong = self.top.shape[1], self.top != top_grid(self.top >= 0)
        middle = np.s_[:, r // 4 : r - r // 4, r // 4 : r - r // 4, r // 4 : r - r // 4]
        if self.shells > 1 and (self.top.reshape(-1, r, r, r)[1:][middle] >= 0).any():
            return [Problem("top", "has a brick of a shell in a smaller shell", "each place in one shell")]
        return count_problem("top", wrong, self.top, "bricks in raster order, and the distance to the nearest")

    def _row_problems(self) -> list[Problem]:
        flat = self.rows.reshape(-1)
        wrong = (flat < EMPTY) | (flat >= 2 * self.n)
        if wrong.any():
            return count_problem("rows", wrong.reshape(self.rows.shape), self.rows, f"-1 to {2 * self.n - 1:,}")
        met = flat[flat >= 0] >> 1
        most = np.maximum.accumulate(met) if len(met) else met
        if np.any(most[1:] > most[:-1] + 1) or (len(met) and met[0]) or int(most[-1] if len(met) else -1) != self.n - 1:
            return [Problem("rows", "are not numbered in order", "0, 1, 2, ... in order of first occurrence")]
        torn = np.zeros(-(-self.b // _CHUNK), bool)

        def look(begin: int, end: int) -> None:
            pairs = self.rows[begin:end].reshape(-1, 4, 2, 4, 2, 4, 2).transpose(0, 1, 3, 5, 2, 4, 6).reshape(-1, 8)
            wide = (pairs >= 0) & (pairs & 1 == 1)
            torn[begin // _CHUNK] = np.any(wide.any(axis=1) & (pairs != pairs[:, :1]).any(axis=1))

        over_chunks(look, self.b, _CHUNK)
        if torn.any():
            return [
                Problem("rows", "have an incomplete wide cell", "2^3 cells at an even position, all eight the same")
            ]
        if np.any(np.bincount(met, minlength=self.n) != np.where(self.wide, 8, 1)):
            return [
                Problem("rows", "contain a cell twice", "each row once, a wide one in the eight cells that it covers")
            ]
        return []
