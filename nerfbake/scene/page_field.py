"""A radiance field as a fragment shader reads it: two dependent fetches a step, and the colours of what is met."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.maths.affine import placed
from nerfbake.scene.basis import Basis
from nerfbake.scene.shown import Shown

CELL, BLOCK = 8, 4  # voxels along an edge of a top cell, and of the eight blocks in it
WHOLE = 1 << 30  # a top cell from here on is one row
ALL = 255  # in place of a block's count: all of it is one row
FARTHEST = 15  # top cells that a distance reaches
LARGEST = float(np.finfo(np.float16).max)


@dataclass(frozen=True, eq=False, repr=False)
class PageField(Shown):
    """Voxels in a grid of top cells of 8^3, which hold eight blocks of 4^3 each, and a row of colours for each voxel.

    top     (X, Y, Z) int32. Below 0: empty, and so is every cell that is nearer (along all three axes) than minus this
            number of cells, 15 at most; from 0: the number of a leaf; from 2^30: the whole cell has row top - 2^30
    blocks  (8 leaves, 4) uint32, block 4 x + 2 y + z of each leaf: the mask's lower and upper half, the row of the
            first voxel, and how many bits the lower half has; 255 there: the whole block has that row. Bit
            16 x + 4 y + z of a mask is a voxel of the block; its row is the first plus how many bits are below its own
    texels  (rows, T, 4) float16, T = 1 + 3 ceil((B - 1) / 4): red, green and blue of the first coefficient and the
            density; then red, green, blue of the second, of the third, ..., without a gap, zeros behind the last
    density_unit  densities are multiples of this, a power of two, in 1/world unit
    place   (3, 4) float64: voxels = place @ (world, 1)
    box     (2, 3) float64: in voxels, around all that is not empty, within the grid
    basis   SH or RGBA, in the field's own axes

    >>> import numpy as np
    >>> from nerfbake import build_field, build_page_field, sample_n3tree
    >>> page_field = build_page_field(build_field(sample_n3tree(resolution=16)))
    >>> page_field.top.shape, page_field.texels.shape[1:]
    ((2, 2, 2), (7, 4))
    """

    top: npt.NDArray[np.int32]
    blocks: npt.NDArray[np.uint32]
    texels: npt.NDArray[np.float16]
    density_unit: float
    place: Points
    box: Points
    basis: Basis

    def __post_init__(self) -> None:
        leaves, rows = len(self.blocks) // 8, len(self.texels)
        for name, shape, dtype in (
            ("top", self.top.shape[:3], np.int32),
            ("blocks", (8 * leaves, 4), np.uint32),
            ("texels", (rows, texels_of(self.basis), 4), np.float16),
            ("place", (3, 4), np.float64),
            ("box", (2, 3), np.float64),
        ):
            array = getattr(self, name)
            if array.shape != shape or array.dtype != dtype or (array.size == 0 and name == "top"):
                found = f"has shape {array.shape}, dtype {array.dtype}"
                raise InvalidScene(Problem(f"the page field's {name}", found, f"{shape} {np.dtype(dtype)}"))

    def __str__(self) -> str:
        grid = "x".join(map(str, self.top.shape))
        return f"{self.basis} page field of {len(self.texels):,} rows, {grid} cells of {CELL}^3"

    def rows(self, points: Points) -> npt.NDArray[np.int64]:
        """(m,) the row at each point (m, 3) in voxels, -1 where there is none: the shader's lookup, line by line."""
        found = np.full(len(points), -1, np.int64)
        at = np.flatnonzero(((points >= 0) & (points < CELL * np.array(self.top.shape))).all(axis=1))
        x, y, z = points[at].astype(np.int64).T
        cell = self.top[x >> 3, y >> 3, z >> 3].astype(np.int64)
        found[at[cell >= WHOLE]] = cell[cell >= WHOLE] - WHOLE
        inside = (cell >= 0) & (cell < WHOLE)
        at, cell, x, y, z = at[inside], cell[inside], x[inside], y[inside], z[inside]
        block = self.blocks[8 * cell + (x >> 2 & 1) * 4 + (y >> 2 & 1) * 2 + (z >> 2 & 1)].astype(np.int64)
        bit = (x & 1) << 4 | (y & 3) << 2 | z & 3
        upper = (x >> 1 & 1).astype(bool)
        half = np.where(upper, block[:, 1], block[:, 0])
        below = np.bitwise_count(half & (1 << bit) - 1)
        whole = block[:, 3] == ALL
        row = block[:, 2] + np.where(whole, 0, below + np.where(upper, block[:, 3], 0))
        found[at] = np.where(half >> bit & 1, row, -1)
        return found

    def sample(self, points: Points) -> npt.NDArray[np.float32]:
        """(m, 3) in the world -> (m, 3 B + 1) of the voxel around each point, zeros where there is none."""
        rows = self.rows(placed(points, self.place))
        found = np.zeros((len(points), self.basis.data_dim), np.float32)
        found[rows >= 0] = self.values[rows[rows >= 0]]
        return found

    @property
    def values(self) -> npt.NDArray[np.float32]:
        """(rows, 3 B + 1) float32: coefficients of red, of green, of blue, then the density per world unit."""
        B, flat = self.basis.size, self.texels.reshape(-1, 4 * texels_of(self.basis)).astype(np.float32)
        values = np.empty((len(flat), 3 * B + 1), np.float32)
        for channel in range(3):
            values[:, channel * B] = flat[:, channel]
            values[:, channel * B + 1 : (channel + 1) * B] = flat[:, 4 + channel : 4 + 3 * (B - 1) : 3]
        values[:, 3 * B] = flat[:, 3] * np.float32(self.density_unit)
        return values


def grid_of(box: Points) -> tuple[npt.NDArray[np.int64], tuple[int, int, int]]:
    """The voxel that a grid around this box starts at, and its top cells along x, y, z."""
    start = (box[0] // CELL).astype(np.int64) * CELL
    x, y, z = (-(-(np.ceil(box[1]).astype(np.int64) - start) // CELL)).tolist()
    return start, (x, y, z)


def density_unit(densest: float) -> float:
    """1 where float16 holds densities as they are; else the power of two that puts the densest just below its end."""
    return 1.0 if 1 <= densest <= LARGEST else float(2.0 ** (np.frexp(densest)[1] - 15))


def texels_of(basis: Basis) -> int:
    """RGBA texels of a row."""
    return 1 + 3 * -(-(basis.size - 1) // 4)
