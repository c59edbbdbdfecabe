"""The field that other programs train: values at the nodes of a lattice, interpolated first and then activated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from math import ceil
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Points, Singles
from nerfbake.kernels.soundness import all_finite, place, plural
from nerfbake.scene.base import Scene, edge_problems, number_problems, place_problems, require_shape
from nerfbake.scene.basis import SH_SIZES
from nerfbake.scene.lattice_blocks import Blocks as Blocks
from nerfbake.scene.lattice_blocks import Planes as Planes
from nerfbake.scene.lattice_colour import Colour as Colour
from nerfbake.scene.lattice_colour import DeferredColour as DeferredColour
from nerfbake.scene.lattice_colour import MlpColour as MlpColour
from nerfbake.scene.lattice_colour import RgbColour as RgbColour
from nerfbake.scene.lattice_colour import ShColour as ShColour

MAX_EDGE = 4096  # nodes along an axis
_ROUNDING = 1e-6  # of a cell: what the last bits of a box may add
STEP = 0.5  # of the least distance between nodes: how far the samples of all these programs are apart


class Activation(NamedTuple):
    """The density per world unit that an interpolated value x stands for: scale * kind(x + shift).

    relu  max(0, x).  softplus  ln(1 + e^x).  opacity  -ln(1 - x), of x from 0 to 1 - 1/510: x is the opacity of 1/scale
    world units, and no byte tells anything above from 1.  exponential  e^x
    """

    kind: Literal["relu", "softplus", "opacity", "exponential"] = "relu"
    shift: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True, eq=False, repr=False)
class LatticeField(Scene):
    """A radiance field over a lattice of nodes. Source: docs/formats/checkpoints.md, "What is read".

    links       (X, Y, Z) int32: the row of values at each node; below 0 there is nothing, which reads as zeros
    density     (n,) float32: what the activation makes a density of; below 0, too
    features    (n, C) float16 or float32: what the colour is made of
    activation, colour  how
    box         (2, 3) float64: lowest and highest corner in the world; outside there is nothing
    at_corners  True: the first and the last node of an axis stand on the box; False: each stands at the centre of one
                of X x Y x Z cells, and half a cell before the box's end the last one goes on
    occupied    (X', Y', Z') bool, its first and last nodes on the box: a sample counts where the nearest one is True;
                None: everywhere
    mask_box    (2, 3) float64: where `occupied` is of as many cells of this box instead; outside nothing counts
    least       the least opacity of a sample that counts, over one step
    blocks      where the nodes stand in blocks, which links lead to: (X, Y, Z) of blocks. Their colour is deferred
    planes      of a lattice of blocks, what is added to its values before they are activated
    dialect     which program's file it was
    notes       what was left out or taken for granted, a line each

    >>> import numpy as np
    >>> from nerfbake import LatticeField
    >>> from nerfbake.scene.lattice_field import Activation, RgbColour
    >>> links = np.arange(8, dtype=np.int32).reshape(2, 2, 2)
    >>> box = np.array([[0.0] * 3, [1.0] * 3])
    >>> grey = np.zeros((8, 3), np.float32)
    >>> print(LatticeField(links, np.ones(8, np.float32), grey, Activation(), RgbColour(), box))
    lattice field of 2x2x2, 8 nodes, RGB
    """

    links: npt.NDArray[np.int32]
    density: Singles
    features: npt.NDArray[Any]
    activation: Activation
    colour: Colour
    box: Points
    at_corners: bool = False
    occupied: Bits | None = None
    mask_box: Points | None = None
    least: float = 0.0
    dialect: str = ""
    notes: tuple[str, ...] = ()
    blocks: Blocks | None = None
    planes: Planes | None = None

    def __post_init__(self) -> None:
        shape = self.links.shape
        least = 1 + self.at_corners
        if self.links.ndim != 3 or self.links.dtype != np.int32 or not all(least <= e <= MAX_EDGE for e in shape):
            found = f"has shape {shape}, dtype {self.links.dtype}"
            raise InvalidScene(Problem("links", found, f"(X, Y, Z) int32, {least} to {MAX_EDGE} nodes an axis"))
        if isinstance(self.colour, ShColour) and self.colour.size not in SH_SIZES:
            sizes = ", ".join(map(str, SH_SIZES))
            raise InvalidScene(Problem("colours", f"have {self.colour.size} coefficients a channel", sizes))
        require_shape("density", self.density, (len(self.density),), np.float32)
        if self.features.dtype != np.float16 or self.features.shape != (self.n, self.colour.features):
            require_shape("colours", self.features, (self.n, self.colour.features), np.float32)
        require_shape("the lattice's box", self.box, (2, 3), np.float64)
        if self.occupied is not None and (self.occupied.ndim != 3 or 0 in self.occupied.shape):
            found = f"has shape {self.occupied.shape}"
            raise InvalidScene(Problem("the mask", found, "three axes with a node or more each"))
        if self.mask_box is not None:
            if self.occupied is None:
                raise InvalidScene(Problem("the mask", "is missing", "one, as it has a box"))
            require_shape("the mask's box", self.mask_box, (2, 3), np.float64)
        if self.blocks is not None:
            self.blocks.require()
            if not isinstance(self.colour, DeferredColour):
                raise InvalidScene(Problem("the blocks", f"hold {self.colour}", "a deferred colour"))
        if self.planes is not None:
            if self.blocks is None:
                raise InvalidScene(Problem("the planes", "are added to nodes by links", "nodes in blocks"))
            self.planes.require(self.colour.features)

    def __str__(self) -> str:
        size = "x".join(map(str, self.shape))
        return f"lattice field of {size}, {plural(self.n, 'node')}, {self.colour}"

    # -- sizes -------------------------------------------------------------------------------------------------
    @property
    def n(self) -> int:
        """Rows of values."""
        return len(self.density)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along x, y and z; of blocks, cells."""
        if self.blocks is not None:
            return self.cells
        x, y, z = self.links.shape
        return x, y, z

    @property
    def cells(self) -> tuple[int, int, int]:
        """What the box is divided into: as many cells as nodes, or one less where nodes stand at their corners; where
        there are planes, cells of these, and else of the blocks, those that are cut counted as whole ones."""
        if self.blocks is not None:
            x, y, z = (ceil(e - _ROUNDING) for e in (self.box[1] - self.box[0]) / self.spacing)
            return x, y, z
        x, y, z = (edge - self.at_corners for edge in self.shape)
        return x, y, z

    @property
    def spacing(self) -> Points:
        """(3,) from a node to the next, in world units."""
        if self.blocks is not None and self.planes is None:
            whole = self.blocks.box[1] - self.blocks.box[0]
            return np.asarray(whole / (np.array(self.links.shape) * self.blocks.edge), np.float64)
        count = self.cells if self.planes is None else (self.planes.across,)
        return np.asarray((self.box[1] - self.box[0]) / count, np.float64)

    @property
    def step(self) -> float:
        """World units from a sample on a ray to the next."""
        return STEP * float(self.spacing.min())

    @cached_property
    def held_box(self) -> Points:
        """(2, 3) in the world: around all that may hold something."""
        held = self.links >= 0 if self.occupied is None else self.occupied
        own = self.mask_box if self.blocks is None or self.occupied is not None else self.blocks.box
        box = self.box if own is None else own
        corners = own is None and (self.at_corners or self.occupied is not None)
        ends = []
        for axis in range(3):
            there = np.flatnonzero(held.any(axis=tuple({0, 1, 2} - {axis})))
            first, last = (int(there[0]), int(there[-1])) if len(there) else (0, held.shape[axis] - 1)
            count = max(held.shape[axis] - corners, 1)
            ends.append((max(first - corners, 0) / count, min(last + 1, count) / count))
        share = np.array(ends).T
        around = np.asarray(box[0] + share * (box[1] - box[0]), np.float64)
        return around if own is None else np.clip(around, *self.box)

    # -- other fields ------------------------------------------------------------------------------------------
    def scaled(self, scale: float) -> LatticeField:
        """The same field in a world that is so many times larger: densities per world unit fall with it."""
        activation = self.activation._replace(scale=self.activation.scale / scale)
        mask_box = None if self.mask_box is None else self.mask_box * scale
        blocks = None if self.blocks is None else self.blocks._replace(box=self.blocks.box * scale)
        return replace(self, box=self.box * scale, mask_box=mask_box, activation=activation, blocks=blocks)

    # -- soundness ---------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        world = place_problems("the lattice's box", self.box)
        world += [] if world else edge_problems("the lattice's edges", self.box[1] - self.box[0])
        if self.mask_box is not None:
            own = place_problems("the mask's box", self.mask_box)
            world += own or edge_problems("the mask's edges", self.mask_box[1] - self.mask_box[0])
        if self.blocks is not None:
            whole = place_problems("the blocks' box", self.blocks.box)
            world += whole or edge_problems("the blocks' edges", self.blocks.box[1] - self.blocks.box[0])
        world += place_problems("activation", np.array(self.activation[1:]))
        last = self.n - (1 if self.blocks is None else self.blocks.rows)
        beyond = int(self.links.max()) > last
        return world + (self._beyond(last) if beyond else [])

    def _beyond(self, last: int) -> list[Problem]:
        wrong = self.links > last
        index = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
        found, count = f"is {self.links[index]}", int(np.count_nonzero(wrong))
        return [Problem(place("links", index), found, f"below {last + 1:,}, the rows of values", count)]

    def value_problems(self) -> list[Problem]:
        """Values that no renderer can use; only rows that a node has count."""
        mlp = self.colour.mlp if isinstance(self.colour, DeferredColour) else self.colour
        mlp = mlp if isinstance(mlp, MlpColour) else None
        weights, most = (mlp.problems(), mlp.most) if mlp else ([], np.inf)
        # Channels that lie together are not copied, to be looked at row by row.
        features = self.features.T if self.features.flags.f_contiguous else self.features
        if self.planes is not None:
            weights = weights + number_problems("the planes' density", self.planes.density)
            weights += number_problems("the planes' colours", self.planes.features)
        if all_finite(self.density) and all_finite(features) and most == np.inf:
            return weights
        used = np.full(self.n, self.blocks is not None)
        used[self.links[self.links >= 0]] = True
        found = number_problems("density", self.density, where=used)
        found += number_problems("colours", self.features, where=used[:, None])
        if mlp and not found and most < np.inf:
            found = number_problems("colours", self.features[:, -mlp.encoded :], where=used[:, None], most=most)
        return weights + found
