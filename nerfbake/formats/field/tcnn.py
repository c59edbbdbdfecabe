"""tiny-cuda-nn's flat parameters: the matrices of perceptrons, and the rows of hash grids.

    perceptron   first (width, inputs), hidden (width, width) ..., last (outputs, width); row-major, without biases
    hash grid    the rows of level 0, of level 1, ...; F numbers each

A perceptron's inputs and outputs are padded to multiples of 16. The outputs of the padding are never used. The inputs
of the padding are 1, so that their columns act as biases; behind a hash grid they are 0.

Level l of a grid has s = 2^(l log2 b) base - 1 in float32, and ceil(s) + 1 nodes along an axis. Point x of the unit
cube is at x s + 1/2, so that x = 1 is one node past a dense level, whose rows wrap around. A level has as many rows as
nodes, rounded up to a multiple of 8, but 2^T at most.

Source: docs/fields.md, "Programs"; its grid.h, common_device.h, identity.h and fully_fused_mlp.cu.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.scene.network import MAX_FEATURES, MAX_LEVELS, MAX_UNITS, HashGrid, Mlp

ALIGNED = 16
MAX_LOG2_ROWS = 30
FEATURES = (2, 4, 8, 1)  # of a row; all that tiny-cuda-nn has, the most frequent first
_LN2 = 0.6931471805599453
_MOST_DENSE = 1625  # nodes along an axis, whose cube still fits into 32 bits
_MOST_ROWS = (1 << 32) // 2 - 1


class Perceptron(NamedTuple):
    """The sizes of a perceptron. hidden: its hidden layers; ones: the padding of its inputs is 1, else 0."""

    inputs: int
    width: int
    hidden: int
    outputs: int
    ones: bool

    @property
    def shapes(self) -> list[tuple[int, int]]:
        """(rows, columns) of the matrices as they are stored."""
        inputs, outputs = padded(self.inputs), padded(self.outputs)
        if not self.hidden:
            return [(outputs, inputs)]
        return [(self.width, inputs), *[(self.width, self.width)] * (self.hidden - 1), (outputs, self.width)]

    @property
    def numbers(self) -> int:
        return sum(rows * columns for rows, columns in self.shapes)


def padded(count: int) -> int:
    return -(-count // ALIGNED) * ALIGNED


def width_for(numbers: int, *, inputs: int, hidden: int, outputs: int, name: str) -> int:
    """Return the width with which a perceptron has as many numbers. Raises InvalidFile."""
    for width in range(ALIGNED, MAX_UNITS + 1, ALIGNED):
        if Perceptron(inputs, width, hidden, outputs, False).numbers == numbers:
            return width
    found = f"has {numbers:,} numbers"
    allowed = f"{hidden} hidden layers of any multiple of {ALIGNED} units, for {inputs} inputs and {outputs} outputs"
    raise InvalidFile(Problem(name, found, allowed))


def mlp_of(params: Singles, sizes: Perceptron, name: str) -> Mlp:
    """Return the perceptron of flat parameters, which must have exactly its size. Raises InvalidFile."""
    if params.ndim != 1 or len(params) != sizes.numbers:
        allowed = f"{sizes.numbers:,} numbers, for {' x '.join(str(each) for each in sizes.shapes)}"
        raise InvalidFile(Problem(name, f"has shape {params.shape}", allowed))
    weights, at = [], 0
    for rows, columns in sizes.shapes:
        weights.append(params[at : at + rows * columns].reshape(rows, columns))
        at += rows * columns
    constant = np.full(sizes.shapes[0][1] - sizes.inputs, sizes.ones, np.float32)
    bias = bias_with(np.zeros(len(weights[0]), np.float32), weights[0][:, sizes.inputs :], constant)
    biases = [bias, *(np.zeros(len(each), np.float32) for each in weights[1:])]
    weights[0] = weights[0][:, : sizes.inputs]
    weights[-1], biases[-1] = weights[-1][: sizes.outputs], biases[-1][: sizes.outputs]
    return Mlp(tuple(map(np.ascontiguousarray, weights)), tuple(biases))


def bias_with(bias: Singles, columns: Singles, inputs: Singles) -> Singles:
    """(out,) the bias of a layer without its columns (out, k) of inputs (k,) that never change."""
    with np.errstate(invalid="ignore", over="ignore"):  # problems() reports numbers that are not finite
        return np.asarray(bias + (columns.astype(np.float64) * inputs).sum(axis=1), np.float32)


class Grid(NamedTuple):
    """The sizes of a hash grid. growth: the factor from level to level, float32."""

    levels: int
    features: int
    log2_rows: int
    base: int
    growth: np.float32

    @property
    def inputs(self) -> int:
        """Number of features of a point."""
        return self.levels * self.features


def require_grid(grid: Grid, name: str) -> None:
    """Raise InvalidFile for sizes that no grid has."""
    for what, value, least, most in (
        ("levels", grid.levels, 1, MAX_LEVELS),
        ("features per level", grid.features, 1, MAX_FEATURES),
        ("log2 of the rows", grid.log2_rows, 1, MAX_LOG2_ROWS),
        ("nodes of the first level", grid.base, 2, 1 << 20),
    ):
        if not least <= value <= most:
            raise InvalidFile(Problem(name, f"has {value} as the {what}", f"{least:,} to {most:,}"))
    if not 0 < grid.growth < 1 << 20:
        raise InvalidFile(Problem(name, f"grows by {grid.growth:g} from level to level", f"above 0, below {1 << 20:,}"))


def scales_of(levels: int, base: int, log2_growth: np.float32) -> Singles:
    """(L,) float32: 2^(l log2 b) base - 1, each operation in float32, as the kernels compute it."""
    exponents = (np.arange(levels, dtype=np.float32) * log2_growth).astype(np.float64)
    with np.errstate(over="ignore"):  # callers refuse infinity
        return np.asarray(exp(exponents * _LN2).astype(np.float32) * np.float32(base) - np.float32(1), np.float32)


def layout_of(grid: Grid) -> tuple[Ints, Singles, Ints]:
    """Return `first`, `scale` and `dense` of a HashGrid. Raises InvalidFile for levels of too many nodes."""
    scale = scales_of(grid.levels, grid.base, np.float32(log(grid.growth) / _LN2))
    if not (scale < 1 << 24).all():
        found = f"has levels of up to {float(scale.max()):g} nodes along an axis"
        raise InvalidFile(Problem("the hash grid", found, f"below {1 << 24:,}"))
    first, dense = [0], []
    for s in scale.tolist():
        nodes = int(np.ceil(s)) + 1
        rows = min(-(-min(nodes**3, _MOST_ROWS) // 8) * 8, 1 << grid.log2_rows)
        first.append(first[-1] + rows)
        dense.append(nodes if nodes <= _MOST_DENSE and nodes**3 <= rows else 0)
    return np.array(first, np.int64), scale, np.array(dense, np.int64)


def rows_of(grid: Grid) -> int:
    """The number of rows of all levels."""
    return int(layout_of(grid)[0][-1])


def hash_grid_of(params: Singles, grid: Grid, name: str) -> HashGrid:
    """Return the hash grid of flat parameters, which must have exactly its size. Raises InvalidFile."""
    first, scale, dense = layout_of(grid)
    if params.ndim != 1 or len(params) != first[-1] * grid.features:
        found = f"has shape {params.shape}"
        allowed = f"{first[-1] * grid.features:,} numbers, for {first[-1]:,} rows of {grid.features}"
        raise InvalidFile(Problem(name, found, allowed))
    return HashGrid(params.reshape(-1, grid.features), first, scale, dense, 0.5)
