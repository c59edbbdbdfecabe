"""A grid of small networks, each of which computes density and colours in its own cell.

Source: KiloNeRF (Reiser et al., 2021), 3; docs/fields.md.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints, Points, Singles
from nerfbake.kernels.network.mlp import PackedLayers, pack_layers
from nerfbake.kernels.network.mlp_grid import run_perceptrons
from nerfbake.scene.base import edge_problems, number_problems, place_problems, require_shape
from nerfbake.scene.network import MAX_LAYERS, MAX_UNITS, Frequencies
from nerfbake.scene.stage1 import MAX_WEIGHT

MAX_NETWORKS = 1 << 16  # their numbers are stored as float32 beside the features


@dataclass(frozen=True, eq=False)
class Perceptrons:
    """n perceptrons of equal shape: ReLU follows every layer but the last.

    weights  (n, out, in) float32 of each layer
    biases   (n, out) float32 of each layer
    """

    weights: tuple[Singles, ...]
    biases: tuple[Singles, ...]

    def __post_init__(self) -> None:
        if not 1 <= len(self.weights) <= MAX_LAYERS or len(self.weights) != len(self.biases):
            raise InvalidScene(Problem("the networks", f"have {len(self.weights)} layers", f"1 to {MAX_LAYERS}"))
        if any(w.ndim != 3 or 0 in w.shape or max(w.shape[1:]) > MAX_UNITS for w in self.weights):
            found = f"have weights of shapes {', '.join(str(w.shape) for w in self.weights)}"
            raise InvalidScene(Problem("the networks", found, f"(n, out, in), 1 to {MAX_UNITS} out and in"))
        inputs = self.inputs
        for k, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            require_shape(f"layer {k} of the networks", weight, (self.count, weight.shape[1], inputs), np.float32)
            require_shape(f"the bias of layer {k} of the networks", bias, (self.count, weight.shape[1]), np.float32)
            inputs = weight.shape[1]

    def __str__(self) -> str:
        return " x ".join(map(str, [self.inputs, *(weight.shape[1] for weight in self.weights)]))

    @property
    def count(self) -> int:
        return len(self.weights[0])

    @property
    def inputs(self) -> int:
        return int(self.weights[0].shape[2])

    @property
    def outputs(self) -> int:
        return int(self.weights[-1].shape[1])

    @property
    def numbers(self) -> int:
        """The number of weights and biases."""
        return sum(array.size for array in self.weights + self.biases)

    @cached_property
    def packed(self) -> PackedLayers:
        """The layers as kernels take them."""
        return pack_layers(self.weights, self.biases, (), False)

    def __call__(self, which: Ints, inputs: Singles) -> Singles:
        """Return (out, m) for inputs (in, m) float32 of the perceptrons which (m,)."""
        return run_perceptrons(self.packed, which, inputs, self.outputs)

    def problems(self, name: str) -> list[Problem]:
        return [each for array in self.weights + self.biases for each in number_problems(name, array, most=MAX_WEIGHT)]


@dataclass(frozen=True, eq=False)
class NetworkGrid:
    """Density and colour of positions in a box, by one network for each of X x Y x Z cells.

    The features of a point are the outputs of its network and, in the last row, the number of that network, (x Y + y) Z
    + z: features of different networks must not be mixed.

    domain    (2, 3) float64: the box
    cells     X, Y, Z
    encoding  of positions in a cell, from -1 to 1 along each axis
    trunk     computes features from the encoded position, and behind them the density before max(0, x), per unit
    code      of directions
    head      computes the colour before the sigmoid from features and the encoded direction
    """

    domain: Points
    cells: tuple[int, int, int]
    encoding: Frequencies
    trunk: Perceptrons
    code: Frequencies
    head: Perceptrons

    def __post_init__(self) -> None:
        require_shape("the domain of the networks", self.domain, (2, 3), np.float64)
        X, Y, Z = self.cells
        n = self.trunk.count
        if min(self.cells) < 1 or n != X * Y * Z or self.head.count != n or n > MAX_NETWORKS:
            found = f"are {n:,} and {self.head.count:,} in {X} x {Y} x {Z} cells"
            raise InvalidScene(Problem("the networks", found, f"one for each cell, {MAX_NETWORKS:,} at most"))
        features = self.trunk.outputs - 1
        for name, network, inputs in (
            ("the networks", self.trunk, self.encoding.features),
            ("the networks of colours", self.head, features + self.code.features),
        ):
            if network.inputs != inputs:
                raise InvalidScene(Problem(name, f"take {network.inputs} inputs", f"{inputs}"))
        if self.head.outputs != 3 or features < 1:
            found = f"have {features} features and {self.head.outputs} outputs"
            raise InvalidScene(Problem("the networks of colours", found, "1 or more, and 3"))

    def __str__(self) -> str:
        X, Y, Z = self.cells
        return f"{X} x {Y} x {Z} networks of {self.encoding}, {self.trunk}, colours by {self.head}"

    @property
    def numbers(self) -> int:
        """The number of trained numbers."""
        return self.trunk.numbers + self.head.numbers

    def features(self, points: Singles) -> Singles:
        """(G, m) features of points (m, 3), which count as in the nearest cell if they are outside of the domain."""
        # In float32, as the program computes: a rounding of 1e-7 is 1e-4 of a radian at the frequency 2^9.
        low, counts = self.domain[0].astype(np.float32), np.array(self.cells)
        edge = (self.domain[1].astype(np.float32) - low) / counts.astype(np.float32)
        cell = np.clip(np.floor((np.asarray(points, np.float32) - low) / edge), 0, counts - 1).astype(np.float32)
        first = low + edge * cell
        place = 2 * (np.asarray(points, np.float32) - first) / (first + edge - first) - 1
        x, y, z = cell.astype(np.int64).T
        return self.features_in((x * self.cells[1] + y) * self.cells[2] + z, place)

    def features_in(self, which: Ints, places: Singles) -> Singles:
        """(G, m) features of places (m, 3) in the cells of these networks (m,)."""
        found = self.trunk(which, self.encoding(places))
        return np.concatenate([found, which[None].astype(np.float32)])

    def density_of(self, features: Singles) -> Singles:
        """(m,) densities of features (G, m), per unit of the domain."""
        density: Singles = np.maximum(features[-2], np.float32(0))
        return density

    def logits(self, features: Singles, directions: Points) -> Singles:
        """(3, m): the colours before the sigmoid, of features (G, m) in unit directions (m, 3)."""
        which = features[-1].astype(np.int64)
        return self.head(which, np.concatenate([features[:-2], self.code(directions)]))

    def problems(self) -> list[Problem]:
        found = place_problems("the domain of the networks", self.domain)
        found += edge_problems("the domain of the networks", self.domain[1] - self.domain[0])
        found += self.encoding.problems() + self.code.problems()
        return found + self.trunk.problems("the networks") + self.head.problems("the networks of colours")
