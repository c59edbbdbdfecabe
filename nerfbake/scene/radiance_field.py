"""The input of the ray marcher: a tree of cells, the values of its leaves, and its position in the world."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import UsageError
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.march.cells import EMPTY, Cells, rows_at
from nerfbake.kernels.maths.affine import inverse, rotate, transform_points
from nerfbake.scene.base import require_shape
from nerfbake.scene.basis import Basis, renderable_basis
from nerfbake.scene.compact_repr import CompactRepr

_AT_ONCE = 4096  # nodes whose leaves leaf_box() reads together


@dataclass(frozen=True, eq=False, repr=False)
class RadianceField(CompactRepr):
    """A radiance field over a tree of cells, ready to be rendered any number of times.

    cells   the tree (kernels.march.cells); a leaf's slot is its row in `values`
    values  (leaves, 3 B + 1) float32: B coefficients of red, of green, of blue, then the density per world unit
    place   (3, 4) float64: cells of the last level = place @ (world, 1)
    box     (2, 3) float64: in cells, around all leaves, or the whole tree if there are none
    basis   SH or RGBA, in the field's own axes

    >>> import numpy as np
    >>> from nerfbake import build_field, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> field.cells.edge, str(field.basis)
    (8, 'SH9')
    >>> field.sample(np.array([[0.0, 0.0, 9.0]])).shape
    (1, 28)
    """

    cells: Cells
    values: npt.NDArray[np.float32]
    place: Points
    box: Points
    basis: Basis

    def __post_init__(self) -> None:
        renderable_basis(str(self.basis))
        require_shape("the field's values", self.values, (len(self.values), self.basis.data_dim), np.float32)
        require_shape("the field's place", self.place, (3, 4), np.float64)
        require_shape("the field's box", self.box, (2, 3), np.float64)

    def __str__(self) -> str:
        return f"{self.basis} field of {len(self.values):,} leaves over {self.cells.edge}^3 cells"

    @property
    def axes(self) -> Points:
        """(3, 3) the field's own axes in the world, unit vectors as rows; the SH are in these axes."""
        rows = self.place[:, :3] / np.linalg.norm(self.place[:, :3], axis=1, keepdims=True)
        return np.asarray(rows, np.float64)

    @cached_property
    def densities(self) -> npt.NDArray[np.float32]:
        """(leaves,) densities in an array of their own, which fits into a core's cache when `values` does not."""
        memory.require("the field's densities", 4 * len(self.values))
        return np.ascontiguousarray(self.values[:, -1])

    def world(self, points: Points) -> Points:
        """Convert points (m, 3) from cells to the world."""
        return rotate(points - self.place[:, 3], inverse(self.place[:, :3]))

    def sample(self, points: Points) -> npt.NDArray[np.float32]:
        """The values (m, 3 B + 1) of the leaves around world points (m, 3); zeros if there is none."""
        rows = rows_at(self.cells, transform_points(points, self.place))
        found = np.zeros((len(points), self.basis.data_dim), np.float32)
        found[rows >= 0] = self.values[rows[rows >= 0]]
        return found

    def leaf_centres(self, most: int) -> Points:
        """World centres (m, 3) of the leaves, at most `most` of them, evenly selected."""
        centres = [corners + width / 2 for corners, width in leaves_of(self.cells)] or [np.empty((0, 3))]
        found = np.concatenate(centres)
        return self.world(found[np.linspace(0, len(found) - 1, most).astype(int)] if len(found) > most else found)


def require_field(scene: Any) -> RadianceField:
    """Return the field itself. Raises UsageError for any other scene.

    Building a field is too expensive to be repeated for each picture.
    """
    if not isinstance(scene, RadianceField):
        raise UsageError(f"{type(scene).__name__} is not a RadianceField; allowed: the result of build_field()")
    return scene


def leaves_of(cells: Cells, at_once: int | None = None) -> Iterator[tuple[Points, float]]:
    """Yield the lowest corners (m, 3) of each level's leaves and their width, in cells of the last level.

    at_once: yield the leaves of at most this many nodes together; None: of the whole level.
    """
    nodes, corner = np.zeros(1, np.int64), np.zeros((1, 3))
    for first, bits, width in zip(cells.first, cells.bits, cells.width, strict=True):
        steps = np.stack(np.unravel_index(np.arange(1 << 3 * bits), (1 << bits,) * 3), axis=1)
        below, count = [(nodes[:0], corner[:0])], at_once or max(len(nodes), 1)
        for begin in range(0, len(nodes), count):
            part, place = nodes[begin : begin + count], corner[begin : begin + count]
            slots = cells.slots[first + (part[:, None] << 3 * bits) + np.arange(1 << 3 * bits)]
            node, cell = np.nonzero(slots < EMPTY)
            if len(node):
                yield place[node] + steps[cell] * width, float(width)
            node, cell = np.nonzero(slots >= 0)
            below.append((slots[node, cell].astype(np.int64), place[node] + steps[cell] * width))
        nodes, corner = (np.concatenate(each) for each in zip(*below, strict=True))


def leaf_box(cells: Cells, limit: npt.ArrayLike = np.inf) -> Points:
    """(2, 3) box around all leaves, up to `limit`; around the whole tree if there are none."""
    low, high = np.full(3, float(cells.edge)), np.zeros(3)
    for corners, width in leaves_of(cells, _AT_ONCE):
        low = np.minimum(low, corners.min(axis=0))
        high = np.maximum(high, corners.max(axis=0) + width)
    high = np.minimum(high, limit)
    return np.stack([low, high]) if (low < high).all() else np.array([[0.0] * 3, [cells.edge] * 3])
