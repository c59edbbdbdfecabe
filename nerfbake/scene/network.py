"""The networks of radiance fields: encodings of positions, perceptrons, and how colours depend on the direction.

Programs order the inputs and outputs of their layers in different ways. Readers of formats reorder the weights, so that
each kind of network exists once. Source: docs/fields.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from math import sqrt
from typing import TYPE_CHECKING, Literal

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats, Ints, Points, Singles
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import exp, expm1, log, sine_cosine
from nerfbake.scene.base import number_problems, require_shape
from nerfbake.scene.basis import SH_SIZES
from nerfbake.scene.lattice_field import Activation
from nerfbake.scene.stage1 import MAX_WEIGHT

if TYPE_CHECKING:  # compiled code is imported when a network is evaluated, so that it can be described without
    from nerfbake.kernels.network.mlp import PackedLayers

MAX_UNITS, MAX_LAYERS = 4096, 32
MAX_LEVELS, MAX_FEATURES = 64, 32  # of a hash grid
_MOST_LOGIT = 80.0  # a larger input of an exponential would overflow float32


@dataclass(frozen=True, eq=False)
class Mlp:
    """A perceptron: ReLU follows every layer but the last.

    weights  (out, in) float32 of each layer
    biases   (out,) float32 of each layer
    skips    the layers, counted from 0, that also take the perceptron's inputs, after the outputs of the layer before
    rectified  ReLU follows the last layer, too
    """

    weights: tuple[Singles, ...]
    biases: tuple[Singles, ...]
    skips: tuple[int, ...] = ()
    rectified: bool = False

    def __post_init__(self) -> None:
        if not 1 <= len(self.weights) <= MAX_LAYERS or len(self.weights) != len(self.biases):
            raise InvalidScene(Problem("the network", f"has {len(self.weights)} layers", f"1 to {MAX_LAYERS}"))
        if any(w.ndim != 2 or 0 in w.shape or max(w.shape) > MAX_UNITS for w in self.weights):
            found = f"has weights of shapes {', '.join(str(w.shape) for w in self.weights)}"
            raise InvalidScene(Problem("the network", found, f"matrices of 1 to {MAX_UNITS} rows and columns"))
        inputs = self.inputs
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            columns = inputs + (self.inputs if k in self.skips else 0)
            require_shape(f"layer {k} of the network", weight, (len(weight), columns), np.float32)
            require_shape(f"the bias of layer {k} of the network", bias, (len(weight),), np.float32)
            inputs = len(weight)

    def __str__(self) -> str:
        *hidden, last = map(len, self.weights)
        return " x ".join(map(str, [self.inputs, *hidden, last]))

    @property
    def inputs(self) -> int:
        return int(self.weights[0].shape[1])

    @property
    def outputs(self) -> int:
        return len(self.weights[-1])

    @property
    def numbers(self) -> int:
        """The number of weights and biases."""
        return sum(w.size for w in self.weights + self.biases)

    @cached_property
    def packed(self) -> PackedLayers:
        """The layers as kernels take them."""
        from nerfbake.kernels.network.mlp import pack_layers

        return pack_layers(self.weights, self.biases, self.skips, self.rectified)

    def __call__(self, inputs: Singles) -> Singles:
        """Return (out, m) for inputs (in, m) float32."""
        from nerfbake.kernels.network.mlp import run_mlp

        return run_mlp(self.packed, inputs, self.outputs)

    def problems(self, name: str) -> list[Problem]:
        numbers = np.concatenate([array.reshape(-1) for array in self.weights + self.biases])
        return number_problems(name, numbers, most=MAX_WEIGHT)


@dataclass(frozen=True, eq=False)
class Frequencies:
    """Positional encoding: x, y, z, then the sine of x times each frequency, of y, of z, then the cosines likewise.

    frequencies  (k,) float64, in radians per unit
    rounded      as nerfstudio and JaxNeRF compute them: angles are products of x, `unit` and a frequency in float32,
                 which moves those above 1,024 by up to 6e-5, and cosines are sines of an angle plus pi/2 in float32
    unit         radians per unit at the frequency 1
    """

    frequencies: Floats
    rounded: bool = False
    unit: float = 1.0

    def __str__(self) -> str:
        return f"{len(self.frequencies)} frequencies"

    @property
    def features(self) -> int:
        return 3 + 6 * len(self.frequencies)

    def __call__(self, points: Points | Singles) -> Singles:
        """(3 + 6 k, m) float32 code of points or directions (m, 3)."""
        count = 3 * len(self.frequencies), len(points)
        if self.rounded:
            scaled = np.asarray(points, np.float32).T[:, None, :] * np.float32(self.unit)
            angles = (scaled * self.frequencies.astype(np.float32)[:, None]).reshape(count)
            sine = sine_cosine(angles.astype(np.float64))[0]
            cosine = sine_cosine((angles + np.float32(np.pi / 2)).astype(np.float64))[0]
        else:
            wide = np.asarray(points, np.float64).T[:, None, :] * self.unit
            sine, cosine = sine_cosine((wide * self.frequencies[:, None]).reshape(count))
        return np.concatenate([np.asarray(points).T, sine, cosine]).astype(np.float32)

    def problems(self) -> list[Problem]:
        return number_problems("frequencies", self.frequencies * self.unit, most=1e6)


@dataclass(frozen=True, eq=False)
class HashGrid:
    """A multiresolution hash grid over the unit cube. Source: Instant Neural Graphics Primitives (Müller et al., 2022).

    table  (n, F) float32: the rows of all levels, one level after the other
    first  (L + 1,) int64: the first row of each level, and n
    scale  (L,) float32: point p is at p * scale + shift, in nodes of the level
    dense  (L,) int64: the nodes along an axis of a level whose rows have x fastest; 0 for a hashed level
    shift  1/2 in tiny-cuda-nn's grids, 0 in nerfstudio's own
    """

    table: Singles
    first: Ints
    scale: Singles
    dense: Ints
    shift: float

    def __post_init__(self) -> None:
        L = len(self.scale)
        if self.table.ndim != 2 or not 1 <= L <= MAX_LEVELS or not 1 <= self.table.shape[1] <= MAX_FEATURES:
            found = f"has {L} levels and a table of shape {self.table.shape}"
            raise InvalidScene(Problem("the hash grid", found, f"{MAX_LEVELS} levels, {MAX_FEATURES} features at most"))
        require_shape("the hash grid's table", self.table, self.table.shape, np.float32)
        require_shape("the hash grid's scale", self.scale, (L,), np.float32)
        for name, array, count in (("first rows", self.first, L + 1), ("dense levels", self.dense, L)):
            require_shape(f"the hash grid's {name}", array, (count,), np.int64)
        if self.first[0] != 0 or self.first[-1] != len(self.table) or (np.diff(self.first) < 1).any():
            found = f"has levels from row {self.first.tolist()}"
            raise InvalidScene(Problem("the hash grid", found, f"ascending numbers, 0 to {len(self.table)}"))
        if (
            not ((self.scale > 0) & (self.scale < 1 << 24)).all()
            or not ((self.dense >= 0) & (self.dense < 1 << 20)).all()
        ):
            found = f"has scales {self.scale.tolist()}"
            raise InvalidScene(Problem("the hash grid", found, f"above 0, below {1 << 24:,}"))

    def __str__(self) -> str:
        return f"hash grid of {len(self.scale)} levels x {self.table.shape[1]}, {len(self.table):,} rows"

    @property
    def features(self) -> int:
        return int(len(self.scale) * self.table.shape[1])

    @property
    def numbers(self) -> int:
        """The number of trained numbers."""
        return int(self.table.size)

    def __call__(self, points: Points | Singles) -> Singles:
        """(L F, m) float32 features of points (m, 3) in the unit cube; float32 as in the programs."""
        from nerfbake.kernels.network.hash_grid import Levels, grid_features

        levels = Levels(self.table, self.first, self.scale, self.shift, self.dense)
        return grid_features(levels, np.asarray(points, np.float32))

    def problems(self) -> list[Problem]:
        return number_problems("the hash grid", self.table, most=MAX_WEIGHT)


@dataclass(frozen=True, eq=False)
class PlaneProducts:
    """Products of three planes over the unit cube, on several scales. Source: K-Planes (Fridovich-Keil et al., 2023).

    values  (n,) float32: for each scale its planes across x and y (Y, X, C), x and z (Z, X, C), y and z (Z, Y, C)
    nodes   (S, 3) int64: X, Y, Z of each scale; the outermost nodes are on the faces of the cube
    channels  C, the features of one scale
    concatenated  the features of the scales follow each other; False: they are added
    """

    values: Singles
    nodes: Ints
    channels: int
    concatenated: bool = True

    def __post_init__(self) -> None:
        S = len(self.nodes)
        require_shape("the nodes of the planes", self.nodes, (S, 3), np.int64)
        if not 1 <= S <= MAX_LEVELS or not 1 <= self.channels <= MAX_UNITS:
            found = f"have {S} scales of {self.channels} features"
            raise InvalidScene(Problem("the planes", found, f"1 to {MAX_LEVELS} scales, {MAX_UNITS} features at most"))
        if not ((self.nodes >= 1) & (self.nodes < 1 << 20)).all():
            raise InvalidScene(Problem("the planes", f"have {self.nodes.tolist()} nodes", "1 or more along each axis"))
        count = self.channels * sum(X * Y + X * Z + Y * Z for X, Y, Z in self.nodes.tolist())
        require_shape("the planes", self.values, (count,), np.float32)

    def __str__(self) -> str:
        return (
            f"planes of {', '.join('x'.join(map(str, each)) for each in self.nodes.tolist())} nodes x {self.channels}"
        )

    @property
    def features(self) -> int:
        return self.channels * (len(self.nodes) if self.concatenated else 1)

    @property
    def numbers(self) -> int:
        """The number of trained numbers."""
        return int(self.values.size)

    def __call__(self, points: Points | Singles) -> Singles:
        """(features, m) float32 of points (m, 3) in the unit cube; float32 as in the program."""
        from nerfbake.kernels.network.planes import PackedPlanes, plane_features

        packed = PackedPlanes(self.values, self.nodes, self.channels)
        return plane_features(packed, np.asarray(points, np.float32), concatenated=self.concatenated)

    def problems(self) -> list[Problem]:
        return number_problems("the planes", self.values, most=MAX_WEIGHT)


Encoding = Frequencies | HashGrid | PlaneProducts


@dataclass(frozen=True, eq=False)
class HeadColour:
    """The sigmoid of a perceptron's three outputs for features and a direction.

    mlp   its inputs are the features, then the code of the direction
    code  SH16: spherical harmonics of the direction d; shifted: their polynomials at (d + 1) / 2, all with positive
          signs, as nerfstudio's own implementation has them; a Frequencies; none: the colour does not depend on d
    """

    mlp: Mlp
    code: Literal["SH16", "shifted", "none"] | Frequencies

    def __str__(self) -> str:
        return f"colours by {self.mlp} of " + ("the direction's code" if self.code != "none" else "positions alone")

    @property
    def features(self) -> int:
        return self.mlp.inputs - self.coded

    @property
    def coded(self) -> int:
        """Number of inputs that encode the direction."""
        return self.code.features if isinstance(self.code, Frequencies) else 0 if self.code == "none" else 16

    def encoded(self, directions: Points) -> Singles:
        """(coded, m) float32 code of unit directions (m, 3)."""
        if isinstance(self.code, Frequencies):
            return self.code(directions)
        if self.code == "none":
            return np.empty((0, len(directions)), np.float32)
        return _shifted(directions) if self.code == "shifted" else sh_basis(directions, 16, np.float32).T

    def logits(self, features: Singles, directions: Points) -> Singles:
        """(3, m): the colours before the sigmoid."""
        return self.mlp(np.concatenate([features, self.encoded(directions)]))


@dataclass(frozen=True, eq=False)
class BasisColour:
    """The sigmoid of coefficients that a perceptron computes, times basis functions of the direction.

    mlp    its outputs are the B coefficients of red, of green, of blue
    lobes  (B, 4) float32: axis and sharpness s of spherical Gaussians e^(s (axis . d - 1)) / B; None: spherical
           harmonics
    """

    mlp: Mlp
    lobes: Singles | None = None

    def __str__(self) -> str:
        return f"{'SH' if self.lobes is None else 'SG'}{self.size} by {self.mlp}"

    @property
    def features(self) -> int:
        return self.mlp.inputs

    @property
    def size(self) -> int:
        """B, the coefficients of a channel."""
        return self.mlp.outputs // 3

    def basis(self, directions: Points) -> Floats:
        """(m, B) basis functions at unit directions (m, 3)."""
        if self.lobes is None:
            return sh_basis(directions, self.size)
        axes, sharpness = self.lobes[:, :3].astype(np.float64), self.lobes[:, 3].astype(np.float64)
        cosine = (np.asarray(directions)[:, None, :] * axes).sum(axis=2)
        return np.asarray(exp(sharpness * (cosine - 1)) / self.size, np.float64)

    def logits(self, features: Singles, directions: Points) -> Singles:
        """(3, m): the colours before the sigmoid."""
        coefficients = self.mlp(features).reshape(3, self.size, -1)
        return np.asarray((coefficients * self.basis(directions).T).sum(axis=1), np.float32)


Colour = HeadColour | BasisColour


@dataclass(frozen=True, eq=False)
class Network:
    """Density and colour of positions in the encoding's own coordinates.

    encoding  of positions
    trunk     computes the G features from the encoded position
    density   (G,) float32: weights of the features, whose sum plus density_bias is the input of the activation
    activation  its densities are per unit of the field's own coordinates
    colour    of features and directions
    """

    encoding: Encoding
    trunk: Mlp
    density: Singles
    density_bias: float
    activation: Activation
    colour: Colour

    def __post_init__(self) -> None:
        if self.trunk.inputs != self.encoding.features:
            found = f"takes {self.trunk.inputs} inputs"
            raise InvalidScene(Problem("the network", found, f"{self.encoding.features}, as {self.encoding} has"))
        require_shape("the weights of the density", self.density, (self.trunk.outputs,), np.float32)
        if self.colour.features != self.trunk.outputs:
            found = f"take {self.colour.features} features"
            raise InvalidScene(Problem("the colours", found, f"{self.trunk.outputs}, as the network has"))
        if isinstance(self.colour, BasisColour):
            B = self.colour.size
            if self.colour.mlp.outputs != 3 * B or (self.colour.lobes is None and B not in SH_SIZES):
                found = f"have {self.colour.mlp.outputs} coefficients"
                raise InvalidScene(Problem("the colours", found, f"3 times {', '.join(map(str, SH_SIZES))}"))
            if self.colour.lobes is not None:
                require_shape("the lobes", self.colour.lobes, (B, 4), np.float32)
        elif self.colour.mlp.outputs != 3:
            raise InvalidScene(Problem("the colours", f"are {self.colour.mlp.outputs} numbers", "3"))

    def __str__(self) -> str:
        return f"{self.encoding}, {self.trunk}, {self.colour}"

    @property
    def numbers(self) -> int:
        """The number of trained numbers."""
        own = 0 if isinstance(self.encoding, Frequencies) else self.encoding.numbers
        return own + self.trunk.numbers + len(self.density) + self.colour.mlp.numbers

    def features(self, points: Singles) -> Singles:
        """(G, m) features of points (m, 3) in the encoding's coordinates."""
        return self.trunk(self.encoding(points))

    def density_of(self, features: Singles) -> Singles:
        """(m,) densities of features (G, m), per unit of the field's own coordinates."""
        weights = self.density.astype(np.float64)
        raw = np.full(features.shape[1], self.density_bias + self.activation.shift)
        for weight, row in zip(weights, features, strict=True):
            if weight:
                raw += weight * row
        return (self.activation.scale * _activated(raw, self.activation.kind)).astype(np.float32)

    def logits(self, features: Singles, directions: Points) -> Singles:
        """(3, m): the colours before the sigmoid, of features (G, m) in unit directions (m, 3)."""
        return self.colour.logits(features, directions)

    def problems(self) -> list[Problem]:
        found = self.encoding.problems() + self.trunk.problems("the network")
        found += self.colour.mlp.problems("the network of colours")
        place = np.append(self.density, np.float32(self.density_bias)).astype(np.float32)
        found += number_problems("the weights of the density", place, most=MAX_WEIGHT)
        if isinstance(self.colour, BasisColour) and self.colour.lobes is not None:
            found += number_problems("the lobes", self.colour.lobes, most=MAX_WEIGHT)
        return found


def _activated(raw: Floats, kind: str) -> Floats:
    if kind == "relu":
        return np.maximum(raw, 0)
    if kind == "exponential":
        return exp(np.minimum(raw, _MOST_LOGIT))
    if kind == "softplus":  # ln(1 + e^x), without overflow
        return np.maximum(raw, 0) + log(2 + expm1(-np.abs(raw)))
    raise InvalidScene(Problem("the activation", f"is {kind}", "relu, exponential or softplus"))


def _shifted(directions: Points) -> Singles:
    """(16, m): nerfstudio's polynomials at (d + 1) / 2. Source: docs/fields.md, "Programs".

    (d + 1) / 2 has no unit length, so the polynomials of degree 3 are not spherical harmonics.
    """
    x, y, z = ((np.asarray(directions, np.float32) + np.float32(1)) / np.float32(2)).astype(np.float64).T
    xx, yy, zz, pi = x * x, y * y, z * z, np.pi
    one, two = sqrt(3 / (4 * pi)), sqrt(15 / (4 * pi))
    a, b, c, d = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi)), sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi))
    rows = [np.full_like(x, 0.5 / sqrt(pi)), one * y, one * z, one * x]
    rows += [two * x * y, two * y * z, sqrt(5 / (16 * pi)) * (3 * zz - 1), two * x * z, two / 2 * (xx - yy)]
    rows += [a * y * (3 * xx - yy), b * x * y * z, c * y * (5 * zz - 1), d * z * (5 * zz - 3), c * x * (5 * zz - 1)]
    rows += [b / 2 * z * (xx - yy), a * x * (xx - 3 * yy)]
    return np.stack(rows).astype(np.float32)
