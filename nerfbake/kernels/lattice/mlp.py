"""An MLP of features and directions: its logits in given directions, or projected onto spherical harmonics.

The first layer is linear before its ReLU, so it splits: its share of a direction is computed once for all features.
Lanes are features: every loop over lanes is vectorised, and every sum has one order.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats, Ints, Singles, as_input, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.kernels.maths.linear import product
from nerfbake.kernels.parallel import on_every_core

LANES = 64  # features at a time


class Layers(NamedTuple):
    """The weights of the layers, for n directions.

    by_feature (H, F); by_direction (n, H), biases included; middle (l, H, H), middle_bias (l, H), last (3, H),
    last_bias (3,). H is a multiple of 4.
    """

    by_feature: Singles
    by_direction: Singles
    middle: Singles
    middle_bias: Singles
    last: Singles
    last_bias: Singles


def layers_for(
    directions: Floats,
    frequencies: tuple[float, ...],
    first: Singles,
    first_bias: Singles,
    middle: Singles,
    middle_bias: Singles,
    last: Singles,
    last_bias: Singles,
) -> Layers:
    """The layers for a set of directions (n, 3); weights as in scene.lattice_field."""
    inputs, extra = positional_encoding(directions, frequencies), -len(first) % 4
    F = first.shape[1] - inputs.shape[1]
    by_direction = product(inputs, np.ascontiguousarray(first[:, F:].T)) + first_bias
    unit, units = (0, extra), (0, 0)  # units of weight zero, whose output is always 0
    layers = (
        np.pad(first[:, :F], (unit, units)),
        np.pad(np.asarray(by_direction, np.float32), (units, unit)),
        np.pad(middle, (units, unit, unit)),
        np.pad(middle_bias, (units, unit)),
        np.pad(last, (units, unit)),
        last_bias,
    )
    return Layers._make(map(as_input, layers))


def positional_encoding(x: Floats, frequencies: tuple[float, ...]) -> Floats:
    """(n, w + 2 w k) positional encoding of directions or features (n, w).

    x, then the sines of the first of them times each frequency, of the second, ..., then the cosines in the same order.
    """
    angles = (x[:, :, None] * np.array(frequencies)).reshape(len(x), x.shape[1] * len(frequencies))
    sine, cosine = sine_cosine(angles)
    return np.concatenate([x, sine, cosine], axis=1)


def logits_along(features: Singles, layers: Layers, ray: Ints) -> Singles:
    """(k, 3) logits of features (k, F), each in the direction with the number ray (k,)."""
    out = np.empty((len(features), 3), np.float32)
    _along(features, layers, ray, out)
    return out


def project_logits(features: Singles, layers: Layers, inverse: Singles) -> Singles:
    """(m, 3 B): inverse (B, n) @ the logits of features (m, F) in all n directions, channel by channel."""
    out = np.empty((len(features), 3 * len(inverse)), np.float32)
    _project(features, layers, inverse, out)
    return out


@compiled()
def dense(weights: Singles, x: Singles, y: Singles) -> None:
    """y (o, lanes) += weights (o, i) @ x (i, lanes), four inputs per pass."""
    inputs = weights.shape[1]
    for o in range(len(weights)):
        total = y[o]
        for i in range(0, inputs - inputs % 4, 4):
            w0, w1, w2, w3 = weights[o, i], weights[o, i + 1], weights[o, i + 2], weights[o, i + 3]
            x0, x1, x2, x3 = x[i], x[i + 1], x[i + 2], x[i + 3]
            for lane in range(LANES):
                total[lane] += (w0 * x0[lane] + w1 * x1[lane]) + (w2 * x2[lane] + w3 * x3[lane])
        for i in range(inputs - inputs % 4, inputs):
            w, row = weights[o, i], x[i]
            for lane in range(LANES):
                total[lane] += w * row[lane]


@compiled()
def _finish_layers(layers: Layers, hidden: Singles, other: Singles, logits: Singles) -> None:
    """Compute the logits (3, lanes) from the sums of the first layer, hidden (H, lanes), which are overwritten."""
    relu(hidden)
    for layer in range(len(layers.middle)):
        bias = layers.middle_bias[layer]
        for o in range(len(other)):
            other[o] = bias[o]
        dense(layers.middle[layer], hidden, other)
        relu(other)
        for o in range(len(other)):
            for lane in range(LANES):
                hidden[o, lane] = other[o, lane]
    for channel in range(3):
        logits[channel] = layers.last_bias[channel]
    dense(layers.last, hidden, logits)


@compiled()
def relu(x: Singles) -> None:
    """ReLU, in place."""
    for o in range(len(x)):
        row = x[o]
        for lane in range(LANES):
            row[lane] = max(row[lane], f32(0))


@on_every_core
@compiled()
def _along(core: int, cores: int, features: Singles, layers: Layers, ray: Ints, out: Singles) -> None:
    k, F = features.shape
    H = len(layers.by_feature)
    for block in range(core, (k + LANES - 1) // LANES, cores):
        begin, end = block * LANES, min((block + 1) * LANES, k)
        x, hidden = np.zeros((F, LANES), np.float32), np.zeros((H, LANES), np.float32)
        other, logits = np.empty((H, LANES), np.float32), np.empty((3, LANES), np.float32)
        for lane in range(end - begin):
            own = ray[begin + lane]
            for i in range(F):
                x[i, lane] = features[begin + lane, i]
            for o in range(H):
                hidden[o, lane] = layers.by_direction[own, o]
        dense(layers.by_feature, x, hidden)
        _finish_layers(layers, hidden, other, logits)
        for lane in range(end - begin):
            for channel in range(3):
                out[begin + lane, channel] = logits[channel, lane]


@on_every_core
@compiled()
def _project(core: int, cores: int, features: Singles, layers: Layers, inverse: Singles, out: Singles) -> None:
    m, F = features.shape
    H, B = len(layers.by_feature), len(inverse)
    for block in range(core, (m + LANES - 1) // LANES, cores):
        begin, end = block * LANES, min((block + 1) * LANES, m)
        x, base = np.zeros((F, LANES), np.float32), np.zeros((H, LANES), np.float32)
        hidden, other = np.empty((H, LANES), np.float32), np.empty((H, LANES), np.float32)
        logits, sums = np.empty((3, LANES), np.float32), np.zeros((3 * B, LANES), np.float32)
        for lane in range(end - begin):
            for i in range(F):
                x[i, lane] = features[begin + lane, i]
        dense(layers.by_feature, x, base)
        for j in range(len(layers.by_direction)):
            own = layers.by_direction[j]
            for o in range(H):
                shift, row, target = own[o], base[o], hidden[o]
                for lane in range(LANES):
                    target[lane] = row[lane] + shift
            _finish_layers(layers, hidden, other, logits)
            for channel in range(3):
                values = logits[channel]
                for b in range(B):
                    share, total = inverse[b, j], sums[channel * B + b]
                    for lane in range(LANES):
                        total[lane] += share * values[lane]
        for lane in range(end - begin):
            for b in range(3 * B):
                out[begin + lane, b] = sums[b, lane]
