"""The field that other programs train: values at the nodes of a lattice, interpolated first and then activated."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Points, Singles
from nerfbake.kernels.soundness import all_finite, place, plural
from nerfbake.scene.base import Scene, edge_problems, number_problems, place_problems, require_shape
from nerfbake.scene.basis import SH_SIZES

MAX_EDGE = 4096  # nodes along an axis
MAX_UNITS, MAX_LAYERS, MAX_FREQUENCY = 1024, 16, 4096.0  # of an MLP
STEP = 0.5  # of the least distance between nodes: how far the samples of all these programs are apart


class Activation(NamedTuple):
    """The density per world unit that an interpolated value x stands for: scale * kind(x + shift).

    relu  max(0, x).  softplus  ln(1 + e^x)
    """

    kind: Literal["relu", "softplus"] = "relu"
    shift: float = 0.0
    scale: float = 1.0


class ShColour(NamedTuple):
    """Each channel is max(0, 1/2 + sum Y_b(d) c_b), with size coefficients of red, then of green, then of blue."""

    size: int

    @property
    def features(self) -> int:
        return 3 * self.size

    def __str__(self) -> str:
        return f"SH{self.size}, cut at 0"


class RgbColour(NamedTuple):
    """Each channel is the sigmoid of its value, the same in every direction."""

    features: int = 3

    def __str__(self) -> str:
        return "RGB"


@dataclass(frozen=True, eq=False)
class MlpColour:
    """The sigmoid of what an MLP makes of features and of the direction: relu between its layers, of H units each.

    first    (H, F + 3 + 6 k) float32, of F features, then of d, of sin and of cos: of d_x times each of k frequencies,
             of d_y, of d_z; and first_bias (H,)
    middle   (l, H, H) and middle_bias (l, H): the layers between; there may be none
    last     (3, H) and last_bias (3,)
    frequencies  (k,)
    direct   False: there are three more features, before the others, which are added to what the MLP makes
    """

    first: Singles
    first_bias: Singles
    middle: Singles
    middle_bias: Singles
    last: Singles
    last_bias: Singles
    frequencies: tuple[float, ...]
    direct: bool = True

    def __post_init__(self) -> None:
        k, layers = len(self.frequencies), len(self.middle)
        H, width = self.first.shape if self.first.ndim == 2 else (0, 0)
        if width < 4 + 6 * k or not 1 <= H <= MAX_UNITS or layers > MAX_LAYERS:
            found = f"has a first layer of {self.first.shape}, and {layers} behind it"
            allowed = f"1 to {MAX_UNITS} units, {MAX_LAYERS} layers, a feature or more, {3 + 6 * k} inputs of direction"
            raise InvalidScene(Problem("the MLP", found, allowed))
        for name, array, shape in (
            ("first", self.first, self.first.shape),
            ("first_bias", self.first_bias, (H,)),
            ("middle", self.middle, (layers, H, H)),
            ("middle_bias", self.middle_bias, (layers, H)),
            ("last", self.last, (3, H)),
            ("last_bias", self.last_bias, (3,)),
        ):
            require_shape(f"the MLP's {name}", array, shape, np.float32)

    def __str__(self) -> str:
        return f"MLP of {len(self.middle) + 1}x{len(self.first)}"

    @property
    def inputs(self) -> int:
        """Features that go through the MLP."""
        return int(self.first.shape[1]) - 3 - 6 * len(self.frequencies)

    @property
    def features(self) -> int:
        return self.inputs + (0 if self.direct else 3)

    def problems(self) -> list[Problem]:
        weights = (self.first, self.first_bias, self.middle, self.middle_bias, self.last, self.last_bias)
        numbers = np.concatenate([each.reshape(-1) for each in weights])
        frequencies = np.array(self.frequencies, np.float64)
        return number_problems("the MLP", numbers) + number_problems("frequencies", frequencies, most=MAX_FREQUENCY)


Colour = ShColour | RgbColour | MlpColour


@dataclass(frozen=True, eq=False)
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
    least       the least opacity of a sample that counts, over one step
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
    least: float = 0.0
    dialect: str = ""
    notes: tuple[str, ...] = ()

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

    def __str__(self) -> str:
        size = "x".join(map(str, self.links.shape))
        return f"lattice field of {size}, {plural(self.n, 'node')}, {self.colour}"

    # -- sizes -------------------------------------------------------------------------------------------------
    @property
    def n(self) -> int:
        """Rows of values."""
        return len(self.density)

    @property
    def shape(self) -> tuple[int, int, int]:
        """Nodes along x, y and z."""
        x, y, z = self.links.shape
        return x, y, z

    @property
    def cells(self) -> tuple[int, int, int]:
        """What the box is divided into: as many cells as nodes, or one less where nodes stand at their corners."""
        x, y, z = (edge - self.at_corners for edge in self.shape)
        return x, y, z

    @property
    def spacing(self) -> Points:
        """(3,) from a node to the next, in world units."""
        return np.asarray((self.box[1] - self.box[0]) / self.cells, np.float64)

    @property
    def step(self) -> float:
        """World units from a sample on a ray to the next."""
        return STEP * float(self.spacing.min())

    @cached_property
    def held_box(self) -> Points:
        """(2, 3) in the world: around all that may hold something."""
        held = self.links >= 0 if self.occupied is None else self.occupied
        corners = self.at_corners or self.occupied is not None
        ends = []
        for axis in range(3):
            there = np.flatnonzero(held.any(axis=tuple({0, 1, 2} - {axis})))
            first, last = (int(there[0]), int(there[-1])) if len(there) else (0, held.shape[axis] - 1)
            count = max(held.shape[axis] - corners, 1)
            ends.append((max(first - corners, 0) / count, min(last + 1, count) / count))
        share = np.array(ends).T
        return np.asarray(self.box[0] + share * (self.box[1] - self.box[0]), np.float64)

    # -- other fields ------------------------------------------------------------------------------------------
    def scaled(self, scale: float) -> LatticeField:
        """The same field in a world that is so many times larger: densities per world unit fall with it."""
        activation = self.activation._replace(scale=self.activation.scale / scale)
        return replace(self, box=self.box * scale, activation=activation)

    # -- soundness ---------------------------------------------------------------------------------------------
    def structure_problems(self) -> list[Problem]:
        world = place_problems("the lattice's box", self.box)
        world += [] if world else edge_problems("the lattice's edges", self.box[1] - self.box[0])
        world += place_problems("activation", np.array(self.activation[1:]))
        beyond = int(self.links.max()) >= self.n
        return world + (self._beyond() if beyond else [])

    def _beyond(self) -> list[Problem]:
        wrong = self.links >= self.n
        index = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
        found, count = f"is {self.links[index]}", int(np.count_nonzero(wrong))
        return [Problem(place("links", index), found, f"below {self.n:,}, the rows of values", count)]

    def value_problems(self) -> list[Problem]:
        """Values that no renderer can use; only rows that a node has count."""
        weights = self.colour.problems() if isinstance(self.colour, MlpColour) else []
        # Channels that lie together are not copied, to be looked at row by row.
        features = self.features.T if self.features.flags.f_contiguous else self.features
        if all_finite(self.density) and all_finite(features):
            return weights
        used = np.zeros(self.n, bool)
        used[self.links[self.links >= 0]] = True
        found = number_problems("density", self.density, where=used)
        return weights + found + number_problems("colours", self.features, where=used[:, None])
