"""Train an MLP on colours from spherical harmonics behind a sigmoid: Adam, on random pairs of a row and a direction.

    h1 = relu(W0 x + b0)    h2 = relu(W1 h1 + b1)    logits = W2 h2 + b2    x: a row's features, then a direction's code

The loss is (sigmoid(logits) - sigmoid(truth))^2 + a thousandth of (logits - truth)^2, with the true logits clamped to
-10 .. 10. The second term provides a gradient where the sigmoid is flat.

A batch is a fixed number of groups. Each group sums the gradients of its pairs, 64 at a time as in kernels.lattice.mlp,
and the sums of the groups are added in order: the same bits for any number of threads.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake import progress
from nerfbake.kernels.arrays import Ints, Singles, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.lattice.mlp import LANES, dense, relu
from nerfbake.kernels.march.traversal import sigmoid_of
from nerfbake.kernels.parallel import on_every_core

BATCH = 2048  # pairs per round
_GROUPS = 8
_RATE, _MEAN, _SQUARE, _LEAST = 4e-3, 0.9, 0.99, 1e-10  # of Adam; the rate falls linearly to 0
_BY_LOGIT, _FARTHEST = f32(1e-3), f32(10)


class TrainingRows(NamedTuple):
    """Training data, all float32.

    features (n, F) and coefficients (n, 3 B) of rows; code (m, E) and basis (m, B) of directions.
    """

    features: Singles
    coefficients: Singles
    code: Singles
    basis: Singles


class Weights(NamedTuple):
    """Two hidden layers of H units, a multiple of 64: first (H, F + E), middle (H, H), last (3, H) and biases."""

    first: Singles
    middle: Singles
    last: Singles
    first_bias: Singles
    middle_bias: Singles
    last_bias: Singles


def train(pairs: TrainingRows, units: int, *, rounds: int, seed: int) -> Weights:
    """Return the weights after this number of batches from a random start. Rows and directions are drawn uniformly."""
    random = np.random.default_rng(seed)
    weights = _start(random, pairs.features.shape[1] + pairs.code.shape[1], units)
    flat = [np.zeros_like(each) for each in weights]
    means, squares = [each.copy() for each in flat], [each.copy() for each in flat]
    left_mean = left_square = 1.0
    for number in progress.each(range(rounds)):
        row = random.integers(0, len(pairs.features), BATCH)
        way = random.integers(0, len(pairs.code), BATCH)
        slopes = _slopes(pairs, weights, row, way)
        left_mean, left_square = left_mean * _MEAN, left_square * _SQUARE
        rate = f32(_RATE * (1 - number / rounds) / (1 - left_mean))
        for each, slope, mean, square in zip(weights, slopes, means, squares, strict=True):
            mean += f32(1 - _MEAN) * (slope - mean)
            square += f32(1 - _SQUARE) * (slope * slope - square)
            each -= rate * mean / (np.sqrt(square / f32(1 - left_square)) + f32(_LEAST))
    return weights


def _start(random: np.random.Generator, inputs: int, units: int) -> Weights:
    """Uniformly random weights with the spread that ReLU requires; biases are 0."""
    shapes = (units, inputs), (units, units), (3, units)
    drawn = (((random.random(shape) * 2 - 1) * np.sqrt(6 / shape[1])).astype(np.float32) for shape in shapes)
    return Weights(*drawn, *(np.zeros(shape[0], np.float32) for shape in shapes))


def _slopes(pairs: TrainingRows, weights: Weights, row: Ints, way: Ints) -> list[Singles]:
    """Gradients of the mean loss of a batch with respect to each of the weights, in their shapes."""
    H, inputs = weights.first.shape
    tiles = (inputs + LANES - 1) // LANES
    by_first = np.zeros((_GROUPS, tiles, H, LANES), np.float32)
    by_middle = np.zeros((_GROUPS, H // LANES, H, LANES), np.float32)
    by_last = np.zeros((_GROUPS, H // LANES, 3, LANES), np.float32)
    by_bias = np.zeros((_GROUPS, 2 * H + 3), np.float32)
    middle_across, last_across = np.ascontiguousarray(weights.middle.T), np.ascontiguousarray(weights.last.T)
    _backpropagate(pairs, weights, middle_across, last_across, row, way, by_first, by_middle, by_last, by_bias)
    bias = _added(by_bias)
    found = [_joined(_added(each)) for each in (by_first, by_middle, by_last)]
    found[0] = found[0][:, :inputs]
    return [*found, bias[:H], bias[H : 2 * H], bias[2 * H :]]


def _added(groups: Singles) -> Singles:
    total: Singles = groups[0]
    for group in groups[1:]:
        total += group
    return total


def _joined(tiles: Singles) -> Singles:
    """(o, 64 t) from tiles (t, o, 64)."""
    return tiles.transpose(1, 0, 2).reshape(tiles.shape[1], -1)


@on_every_core
@compiled()
def _backpropagate(
    core: int,
    cores: int,
    pairs: TrainingRows,
    weights: Weights,
    middle_across: Singles,
    last_across: Singles,
    row: Ints,
    way: Ints,
    by_first: Singles,
    by_middle: Singles,
    by_last: Singles,
    by_bias: Singles,
) -> None:
    H, inputs = weights.first.shape
    each = len(row) // _GROUPS
    for group in range(core, _GROUPS, cores):
        x, x_across = np.zeros((inputs, LANES), np.float32), np.zeros((len(by_first[0]), LANES, LANES), np.float32)
        one, two = np.empty((H, LANES), np.float32), np.empty((H, LANES), np.float32)
        across = np.empty((H // LANES, LANES, LANES), np.float32)
        behind, before = np.empty((H, LANES), np.float32), np.empty((H, LANES), np.float32)
        out = np.empty((3, LANES), np.float32)
        for begin in range(group * each, (group + 1) * each, LANES):
            own, ways = row[begin : begin + LANES], way[begin : begin + LANES]
            _gather(pairs, own, ways, x)
            _layer(weights.first, weights.first_bias, x, one)
            relu(one)
            _layer(weights.middle, weights.middle_bias, one, two)
            relu(two)
            _layer(weights.last, weights.last_bias, two, out)
            _slope_of_logits(pairs, own, ways, out, f32(1 / len(row)))
            _add_products(out, two, across, by_last[group])
            behind[:] = f32(0)
            dense(last_across, out, behind)
            _mask_relu(two, behind)
            _add_products(behind, one, across, by_middle[group])
            before[:] = f32(0)
            dense(middle_across, behind, before)
            _mask_relu(one, before)
            _add_products(before, x, x_across, by_first[group])
            _sum_lanes(before, by_bias[group, :H])
            _sum_lanes(behind, by_bias[group, H : 2 * H])
            _sum_lanes(out, by_bias[group, 2 * H :])


@compiled()
def _gather(pairs: TrainingRows, row: Ints, way: Ints, x: Singles) -> None:
    """Gather features and codes as lanes (inputs, 64)."""
    F = pairs.features.shape[1]
    for lane in range(LANES):
        for i in range(F):
            x[i, lane] = pairs.features[row[lane], i]
        for i in range(pairs.code.shape[1]):
            x[F + i, lane] = pairs.code[way[lane], i]


@compiled()
def _layer(weights: Singles, bias: Singles, x: Singles, y: Singles) -> None:
    for o in range(len(y)):
        y[o] = bias[o]
    dense(weights, x, y)


@compiled()
def _slope_of_logits(pairs: TrainingRows, row: Ints, way: Ints, logits: Singles, share: np.float32) -> None:
    """Replace logits (3, 64) by the gradients of their share of the loss."""
    B = pairs.basis.shape[1]
    for channel in range(3):
        for lane in range(LANES):
            truth = f32(0)
            for b in range(B):
                truth += pairs.basis[way[lane], b] * pairs.coefficients[row[lane], channel * B + b]
            truth = min(max(truth, -_FARTHEST), _FARTHEST)
            shown, wanted = sigmoid_of(logits[channel, lane]), sigmoid_of(truth)
            by_colour = (shown - wanted) * shown * (f32(1) - shown)
            logits[channel, lane] = f32(2) * share * (by_colour + _BY_LOGIT * (logits[channel, lane] - truth))


@compiled()
def _add_products(slopes: Singles, shown: Singles, across: Singles, total: Singles) -> None:
    """Add the gradients of a layer's weights: total (t, o, 64) += slopes (o, 64) times shown (i, 64) of the same lanes.

    across (t, 64, 64) is a buffer for the inputs, one row per lane. Entries beyond the inputs keep their old contents.
    """
    for i in range(len(shown)):
        tile, column = i // LANES, i % LANES
        for lane in range(LANES):
            across[tile, lane, column] = shown[i, lane]
    for tile in range(len(across)):
        dense(slopes, across[tile], total[tile])


@compiled()
def _mask_relu(shown: Singles, slopes: Singles) -> None:
    """Backward pass of a ReLU: the gradient is 0 where the ReLU clamped."""
    for o in range(len(shown)):
        for lane in range(LANES):
            if shown[o, lane] <= f32(0):
                slopes[o, lane] = f32(0)


@compiled()
def _sum_lanes(slopes: Singles, total: Singles) -> None:
    for o in range(len(slopes)):
        found = f32(0)
        for lane in range(LANES):
            found += slopes[o, lane]
        total[o] += found
