"""Where the nodes of a lattice stand in blocks, and planes whose values are added to theirs: MERF's two structures."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points, Singles
from nerfbake.scene.base import require_shape

MAX_BLOCK = 254  # cells along an edge


class Blocks(NamedTuple):
    """Blocks of nodes in place of single ones: a lattice's links (X, Y, Z) lead each to the first of a block's
    (edge + 1)^3 rows, which are x-major; below 0 the block is empty, and nothing is there, whatever the planes say.

    box: (2, 3) float64, what the blocks divide evenly; it may reach beyond the lattice's own box
    """

    edge: int
    box: Points

    @property
    def rows(self) -> int:
        """Of one block."""
        return (self.edge + 1) ** 3

    def require(self) -> None:
        """Raises InvalidScene for another edge than there can be."""
        if not 1 <= self.edge <= MAX_BLOCK:
            raise InvalidScene(Problem("the blocks", f"are {self.edge} cells wide", f"1 to {MAX_BLOCK}"))
        require_shape("the blocks' box", self.box, (2, 3), np.float64)


class Planes(NamedTuple):
    """Values that are interpolated across two axes and added to the nodes': of y and z, of x and z, of x and y.

    density   (3, P, P) float32
    features  (3, P, P, C) float32
    first     where the lowest corner of the lattice's box is, in nodes of the planes along each axis
    across    how many of these the box is wide
    """

    density: Singles
    features: Singles
    first: float
    across: float

    def require(self, features: int) -> None:
        """Raises InvalidScene for planes of other shapes, or that do not reach across the box."""
        P = self.density.shape[1] if self.density.ndim == 3 else 0
        require_shape("the planes' density", self.density, (3, P, P), np.float32)
        require_shape("the planes' colours", self.features, (3, P, P, features), np.float32)
        if not (self.first >= 0 and self.across > 0 and self.first + self.across <= P - 1):
            found = f"have {P} nodes, and the box is from {self.first:g} on {self.across:g} of these wide"
            raise InvalidScene(Problem("the planes", found, "nodes beyond the box"))
