"""Fields trained by other programs: values at the nodes of a lattice, interpolated first and then activated.

Colours are spherical harmonics, sigmoids, or an MLP of the interpolated values. MERF adds two structures: nodes in
blocks, and planes whose values are added to those of the nodes.
"""

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
from nerfbake.scene.stage1 import MAX_WEIGHT

MAX_BLOCK = 254  # cells along an edge


class Blocks(NamedTuple):
    """Nodes that are stored in blocks.

    Each of the lattice's links (X, Y, Z) points to the first of a block's (edge + 1)^3 rows, which are x-major. A
    negative link is an empty block: space is empty there, whatever values the planes have.

    edge  cells along an edge of a block
    box   (2, 3) float64: the box that the blocks divide evenly; it may extend beyond the lattice's own box
    """

    edge: int
    box: Points

    @property
    def rows(self) -> int:
        """Rows of one block."""
        return (self.edge + 1) ** 3

    def require(self) -> None:
        """Raise InvalidScene if `edge` is out of range."""
        if not 1 <= self.edge <= MAX_BLOCK:
            raise InvalidScene(Problem("the blocks", f"are {self.edge} cells wide", f"1 to {MAX_BLOCK}"))
        require_shape("the blocks' box", self.box, (2, 3), np.float64)


class Planes(NamedTuple):
    """Values on three planes, which are interpolated along two axes and added to those of the nodes.

    The planes are (y, z), (x, z) and (x, y).

    density   (3, P, P) float32
    features  (3, P, P, C) float32
    first     position of the lowest corner of the lattice's box, in nodes of the planes along each axis
    across    width of the box, in nodes of the planes
    """

    density: Singles
    features: Singles
    first: float
    across: float

    def require(self, features: int) -> None:
        """Raise InvalidScene if the planes have wrong shapes, or do not cover the box."""
        P = self.density.shape[1] if self.density.ndim == 3 else 0
        require_shape("the planes' density", self.density, (3, P, P), np.float32)
        require_shape("the planes' colours", self.features, (3, P, P, features), np.float32)
        if not (self.first >= 0 and self.across > 0 and self.first + self.across <= P - 1):
            found = f"have {P} nodes, and the box starts at {self.first:g} and is {self.across:g} wide"
            raise InvalidScene(Problem("the planes", found, "planes that cover the box"))


MAX_UNITS, MAX_LAYERS, MAX_FREQUENCY = 1024, 16, 4096.0  # limits of an MLP
MAX_ANGLE = 1e6  # largest argument of a sine, in radians


class ShColour(NamedTuple):
    """Each channel is max(0, 1/2 + sum Y_b(d) c_b), with `size` coefficients of red, then of green, then of blue."""

    size: int

    @property
    def features(self) -> int:
        return 3 * self.size

    def __str__(self) -> str:
        return f"SH{self.size}, cut at 0"


class RgbColour(NamedTuple):
    """Each channel is the sigmoid of its value, independent of the direction."""

    features: int = 3

    def __str__(self) -> str:
        return "RGB"


@dataclass(frozen=True, eq=False)
class MlpColour:
    """The sigmoid of an MLP's output for features and the direction. Hidden layers have H units and relu.

    first    (H, F + 2 e j + 3 + 6 k) float32, with bias first_bias (H,). Inputs: F features, sin and cos of the last e
             of them, d, sin and cos of d. Sines and cosines are of the first component times each of the j or k
             frequencies, of the second component, ...
    middle   (l, H, H) and middle_bias (l, H): the layers in between; l may be 0
    last     (3, H) and last_bias (3,)
    frequencies  (k,) for the direction
    direct   False: three more features come before the others and are added to the MLP's output
    encoded, feature_frequencies  e and (j,), for features that also go through sines and cosines
    """

    first: Singles
    first_bias: Singles
    middle: Singles
    middle_bias: Singles
    last: Singles
    last_bias: Singles
    frequencies: tuple[float, ...]
    direct: bool = True
    encoded: int = 0
    feature_frequencies: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        k, layers = len(self.frequencies), len(self.middle)
        H = len(self.first) if self.first.ndim == 2 else 0
        if self.inputs < max(1, self.encoded) or self.encoded < 0 or not 1 <= H <= MAX_UNITS or layers > MAX_LAYERS:
            found = f"has a first layer of {self.first.shape} and {layers} middle layers"
            allowed = (
                f"1 to {MAX_UNITS} units, {MAX_LAYERS} layers, at least 1 feature, {3 + 6 * k} inputs for direction"
            )
            allowed += f", {self._sines} for features" if self._sines else ""
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
    def weights(self) -> tuple[Singles, Singles, Singles, Singles, Singles, Singles]:
        """first, first_bias, middle, middle_bias, last, last_bias."""
        return self.first, self.first_bias, self.middle, self.middle_bias, self.last, self.last_bias

    @property
    def inputs(self) -> int:
        """Number of features that are inputs of the MLP."""
        width = int(self.first.shape[1]) if self.first.ndim == 2 else 0
        return width - self._sines - 3 - 6 * len(self.frequencies)

    @property
    def _sines(self) -> int:
        """Number of inputs that are sines and cosines of features."""
        return 2 * self.encoded * len(self.feature_frequencies)

    @property
    def features(self) -> int:
        return self.inputs + (0 if self.direct else 3)

    @property
    def most(self) -> float:
        """Largest allowed value of the last `encoded` features, which go through sines; infinity if none do."""
        return MAX_ANGLE / max(self.feature_frequencies) if self._sines else float("inf")

    def problems(self) -> list[Problem]:
        numbers = np.concatenate([each.reshape(-1) for each in self.weights])
        frequencies = np.array(self.frequencies + self.feature_frequencies, np.float64)
        found = number_problems("the MLP", numbers, most=MAX_WEIGHT)
        return found + number_problems("frequencies", frequencies, most=MAX_FREQUENCY)


@dataclass(frozen=True, eq=False)
class DeferredColour:
    """A diffuse colour plus the output of an MLP for the direction, evaluated once per ray. The sum is clamped at 1.

    In a picture the MLP's inputs are the ray's own sums, anywhere else the values of one point.

    Features are red, green, blue and `others` further inputs of the MLP, all multiplied by the opacity, and then the
    opacity itself. A factor common to all of them cancels. squashed: the features contain no opacity, and their
    sigmoids are used. mlp None: nothing is added.
    """

    mlp: MlpColour | None
    others: int = 4
    squashed: bool = False

    def __post_init__(self) -> None:
        if self.mlp and (self.mlp.features != 3 + self.others or not self.mlp.direct or self.mlp.encoded):
            found = f"takes {self.mlp.features} features"
            raise InvalidScene(Problem("the MLP", found, f"{3 + self.others}, 3 of them a colour"))

    @property
    def features(self) -> int:
        return 3 + self.others + (0 if self.squashed else 1)

    def __str__(self) -> str:
        if self.mlp:
            return f"RGB and a deferred {self.mlp}"
        return "RGB" if self.squashed else "RGB by opacity"


Colour = ShColour | RgbColour | MlpColour | DeferredColour


MAX_EDGE = 4096  # nodes along an axis
_ROUNDING = 1e-6  # in cells: tolerance for the rounding of a box
STEP = 0.5  # sample distance as a multiple of the smallest node distance, in all these programs


class Activation(NamedTuple):
    """The density per world unit of an interpolated value x: scale * kind(x + shift).

    relu  max(0, x)
    softplus  ln(1 + e^x)
    opacity  -ln(1 - x), for x from 0 to 1 - 1/510: x is the opacity of 1/scale world units, and no byte distinguishes
             larger values from 1
    exponential  e^x
    """

    kind: Literal["relu", "softplus", "opacity", "exponential"] = "relu"
    shift: float = 0.0
    scale: float = 1.0


@dataclass(frozen=True, eq=False, repr=False)
class LatticeField(Scene):
    """A radiance field over a lattice of nodes. Source: docs/formats/checkpoints.md, "What is read".

    links       (X, Y, Z) int32: the row of values of each node; negative: no values, read as zeros
    density     (n,) float32: input of the activation; may be negative
    features    (n, C) float16 or float32: input of the colour
    activation, colour  how density and colour are computed from them
    box         (2, 3) float64: lowest and highest corner in the world; space is empty outside
    at_corners  True: the first and the last node of an axis are on the box; False: each node is at the centre of one of
                X x Y x Z cells, and the last node's values continue over the last half cell of the box
    occupied    (X', Y', Z') bool, its first and last nodes on the box: a sample counts if its nearest node is True;
                None: everywhere
    mask_box    (2, 3) float64: if set, `occupied` describes the X' x Y' x Z' cells of this box instead; no sample
                outside it counts
    least       smallest opacity over one step for which a sample counts
    blocks      for nodes in blocks, which the links (X, Y, Z) point to. Their colour is deferred
    planes      for a lattice of blocks: values that are added to those of the nodes before the activation
    dialect     the program that wrote the file
    notes       parts of the file that were ignored, and assumptions, one line each

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
            raise InvalidScene(Problem("links", found, f"(X, Y, Z) int32, {least} to {MAX_EDGE} nodes per axis"))
        if isinstance(self.colour, ShColour) and self.colour.size not in SH_SIZES:
            sizes = ", ".join(map(str, SH_SIZES))
            raise InvalidScene(Problem("colours", f"have {self.colour.size} coefficients a channel", sizes))
        require_shape("density", self.density, (len(self.density),), np.float32)
        if self.features.dtype != np.float16 or self.features.shape != (self.n, self.colour.features):
            require_shape("colours", self.features, (self.n, self.colour.features), np.float32)
        require_shape("the lattice's box", self.box, (2, 3), np.float64)
        if self.occupied is not None and (self.occupied.ndim != 3 or 0 in self.occupied.shape):
            found = f"has shape {self.occupied.shape}"
            raise InvalidScene(Problem("the mask", found, "three axes with at least one node each"))
        if self.mask_box is not None:
            if self.occupied is None:
                raise InvalidScene(Problem("the mask", "is missing", "a mask, because its box is set"))
            require_shape("the mask's box", self.mask_box, (2, 3), np.float64)
        if self.blocks is not None:
            self.blocks.require()
            if not isinstance(self.colour, DeferredColour):
                raise InvalidScene(Problem("the blocks", f"hold {self.colour}", "a deferred colour"))
        if self.planes is not None:
            if self.blocks is None:
                raise InvalidScene(Problem("the planes", "are set for nodes that are not in blocks", "nodes in blocks"))
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
        """Nodes along x, y and z; for blocks, cells."""
        if self.blocks is not None:
            return self.cells
        x, y, z = self.links.shape
        return x, y, z

    @property
    def cells(self) -> tuple[int, int, int]:
        """Cells of the box along each axis.

        As many as nodes, or one less if the nodes are at the cells' corners. With planes, the cells of the planes;
        else, with blocks, the cells of the blocks. Partial cells count as whole ones.
        """
        if self.blocks is not None:
            x, y, z = (ceil(e - _ROUNDING) for e in (self.box[1] - self.box[0]) / self.spacing)
            return x, y, z
        x, y, z = (edge - self.at_corners for edge in self.shape)
        return x, y, z

    @property
    def spacing(self) -> Points:
        """(3,) distance between neighbouring nodes, in world units."""
        if self.blocks is not None and self.planes is None:
            whole = self.blocks.box[1] - self.blocks.box[0]
            return np.asarray(whole / (np.array(self.links.shape) * self.blocks.edge), np.float64)
        count = self.cells if self.planes is None else (self.planes.across,)
        return np.asarray((self.box[1] - self.box[0]) / count, np.float64)

    @property
    def step(self) -> float:
        """Distance between samples on a ray, in world units."""
        return STEP * float(self.spacing.min())

    @cached_property
    def held_box(self) -> Points:
        """(2, 3) world box around all nodes that may be non-empty."""
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
        """The same field in a world that is `scale` times larger. Densities per world unit are divided by `scale`."""
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
        """Values that cannot be rendered. Only rows that a node uses are checked."""
        mlp = self.colour.mlp if isinstance(self.colour, DeferredColour) else self.colour
        mlp = mlp if isinstance(mlp, MlpColour) else None
        weights, most = (mlp.problems(), mlp.most) if mlp else ([], np.inf)
        # Check channel-major arrays channel by channel: row by row they would be copied.
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
