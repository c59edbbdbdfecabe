"""The MLP of a specular field for many colours in many directions: sigmoid(relu([d, f] W0) W1) for nerf2mesh.

MobileNeRF's has more features, a layer in between, and biases. The first layer is linear before its ReLU, so it splits:
d W0[:3] is computed once per direction, f W0[3:] once per colour, and each pair requires only one addition per hidden
unit. The fast version processes the directions of a colour in vector registers, four hidden units per pass, with a
separate exponential: 143 million pairs (1.43 million colours, 100 directions, 32 hidden units) take 0.47 s on 2 cores
of an AMD EPYC with AVX-512, and 2.8 s in plain code. Nothing may be reordered, fused or approximated, as with fastmath,
so the last bit is the same on every CPU.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import progress
from nerfbake.kernels.arrays import Singles, f32
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.maths.linear import product
from nerfbake.kernels.parallel import on_every_core

_ROWS = 1 << 16  # colours at a time, for reports of progress
_LOG2_E = f32(1.4426950408889634)
# (2^r - 1) / r for r in [-1/2, 1/2], interpolated at Chebyshev points: 2^r is accurate to 1.4e-7, and 2^0 is 1, so a
# colour is exactly 1/2 where all hidden units are off.
_C1, _C2, _C3 = f32(0.6931472), f32(0.2402235), f32(0.05550381)
_C4, _C5 = f32(0.009666368), f32(0.0013381302)
_BIAS, _MANTISSA = np.int32(127), np.int32(23)


class SplitMlp(NamedTuple):
    """The MLP for a set of n directions. Layers have h hidden units, padded with zeros to a multiple of 4."""

    by_direction: Singles  # (h, n), with the bias
    by_feature: Singles  # (F, h)
    middle: Singles  # (l, h, h): for each layer between the first and the last, a row of weights for each of its units
    middle_bias: Singles  # (l, h)
    w1: Singles  # (3, h)
    bias: Singles  # (3,)


Layers = tuple[Singles, ...]


def split_layers(
    directions: npt.NDArray[Any], w0: Singles, w1: Singles, middle: Layers = (), biases: Layers = ()
) -> SplitMlp:
    """Split the MLP for (n, 3) unit directions.

    w0 (3 + F, h), with rows 0 to 2 for the direction; w1 (h', 3). middle: the weights (in, out) of the layers between
    them. biases: of all layers in order; () for none. Weights must be finite.
    """
    widest = max(w0.shape[1], *(weight.shape[1] for weight in middle), 1)
    widest += -widest % 4  # to whole passes of four units

    def padded(array: npt.NDArray[Any], *shape: int) -> npt.NDArray[Any]:
        return np.pad(array, [(0, size - given) for size, given in zip(shape, array.shape, strict=True)])

    w0, w1 = padded(w0, len(w0), widest), padded(w1, widest, 3)
    between, middle_bias = (
        np.zeros((len(middle), widest, widest), np.float32),
        np.zeros((len(middle), widest), np.float32),
    )
    for k, weight in enumerate(middle):
        between[k] = padded(weight.T, widest, widest)
    each, bias = product(directions, w0[:3]), np.zeros(3, np.float32)
    if biases:
        each += padded(biases[0], widest)
        for k in range(len(middle)):
            middle_bias[k] = padded(biases[1 + k], widest)
        bias = biases[-1]
    by_direction = np.ascontiguousarray(each.T, np.float32)
    by_feature, last = np.ascontiguousarray(w0[3:]), np.ascontiguousarray(w1.T)
    return SplitMlp(by_direction, by_feature, between, middle_bias, last, bias)


def evaluate(
    features: npt.NDArray[Any],
    directions: npt.NDArray[Any],
    w0: Singles,
    w1: Singles,
    middle: Layers = (),
    biases: Layers = (),
) -> Singles:
    """Specular colours in 0..1: (m, F) features in 0..1, (n, 3) unit directions -> (m, 3, n), channel by channel.

    Within 1e-6 of exact arithmetic for weights of the size that training produces.
    """
    out = np.empty((len(features), 3 * len(directions)), np.float32)
    _evaluate(features.astype(np.float32), split_layers(directions, w0, w1, middle, biases), out)
    return out.reshape(len(features), 3, -1)


def evaluate_each(
    features: npt.NDArray[Any],
    directions: npt.NDArray[Any],
    w0: Singles,
    w1: Singles,
    middle: Layers = (),
    biases: Layers = (),
) -> Singles:
    """(m, 3) specular colours in 0..1 of m features (m, F), each in one of m unit directions (m, 3)."""
    inputs = np.concatenate([directions, features], axis=1).astype(np.float32)
    layers = (w0, *middle, w1)
    sizes = np.array([len(w0), *(weight.shape[1] for weight in layers)])
    weights = np.zeros((len(layers), sizes.max(), sizes.max()), np.float32)
    offsets = np.zeros((len(layers), sizes.max()), np.float32)
    for k, weight in enumerate(layers):
        weights[k, : len(weight), : weight.shape[1]] = weight
    for k, bias in enumerate(biases):
        offsets[k, : len(bias)] = bias
    out = np.empty((len(inputs), 3), np.float32)
    _evaluate_each(inputs, weights, offsets, sizes, out)
    return out


def project(features: npt.NDArray[Any], mlp: SplitMlp, basis: Singles, shift: Singles) -> Singles:
    """(m, p) outputs @ basis - shift, with outputs (m, 3n) as evaluate() returns them, but never stored.

    features (m, F), basis (3n, p), shift (p,). The order of the sums does not depend on the number of threads.
    """
    out = np.empty((len(features), len(shift)), np.float32)
    for first in progress.each(range(0, len(features), _ROWS)):
        rows = slice(first, first + _ROWS)
        _project(features[rows].astype(np.float32), mlp, basis, shift, out[rows])
    return out


class AtlasWeights(NamedTuple):
    """The colours that an atlas shows: row i is the sum over t of weight[i, t] table[tiles[i, t]], in 0..1."""

    table: Singles  # (T, 3n)
    tiles: npt.NDArray[np.int32]  # (m, t)
    weight: Singles  # (m, t)


def differences(features: npt.NDArray[Any], mlp: SplitMlp, shown: AtlasWeights) -> npt.NDArray[np.float64]:
    """(m, 4) differences between the shown colours and the MLP's, in 0..255, summed over channels and directions.

    |difference| and its square, first of the values rounded to integers, then of the values themselves.
    """
    out = np.empty((len(features), 4))
    _differences(features.astype(np.float32), mlp, *shown, out)
    return out


def exact_differences(
    features: npt.NDArray[Any], directions: npt.NDArray[Any], w0: Singles, w1: Singles, shown: AtlasWeights
) -> npt.NDArray[np.float64]:
    """Like differences(), with an MLP of two layers in float64, and values truncated to integers instead of rounded.

    For figures that depend on the last bit.
    """
    by_direction = np.ascontiguousarray(product(directions, w0[:3]).T)
    by_feature = product(features, w0[3:])
    out = np.empty((len(features), 4))
    _exact_differences(by_feature, by_direction, np.ascontiguousarray(w1.T, np.float64), *shown, out)
    return out


@compiled(merged=True)
def _show(feature: Singles, mlp: SplitMlp, hidden: Singles, out: Singles) -> None:
    """(3n,) one colour in every direction. hidden (2, h, n): room for the hidden units of two layers.

    The units of the layer before the last are added up as they are computed: with a loop of their own, an MLP of two
    layers takes 2.4 times as long.
    """
    n, zero, deep = mlp.by_direction.shape[1], f32(0), len(mlp.middle) > 0
    given = mlp.by_direction
    if deep:
        _first_layers(feature, mlp, hidden)
        given = hidden[len(mlp.middle) % 2]
    total = out.reshape(3, n)
    for channel in range(3):
        total[channel] = mlp.bias[channel]
    w1 = mlp.w1
    for k in range(0, len(given), 4):
        f0, f1, f2, f3 = zero, zero, zero, zero
        if not deep:
            f0, f1 = _from_feature(feature, mlp.by_feature, k), _from_feature(feature, mlp.by_feature, k + 1)
            f2, f3 = _from_feature(feature, mlp.by_feature, k + 2), _from_feature(feature, mlp.by_feature, k + 3)
        for j in range(n):
            h0, h1, h2, h3 = f0 + given[k, j], f1 + given[k + 1, j], f2 + given[k + 2, j], f3 + given[k + 3, j]
            h0, h1 = h0 if h0 > zero else zero, h1 if h1 > zero else zero
            h2, h3 = h2 if h2 > zero else zero, h3 if h3 > zero else zero
            total[0, j] += h0 * w1[0, k] + h1 * w1[0, k + 1] + h2 * w1[0, k + 2] + h3 * w1[0, k + 3]
            total[1, j] += h0 * w1[1, k] + h1 * w1[1, k + 1] + h2 * w1[1, k + 2] + h3 * w1[1, k + 3]
            total[2, j] += h0 * w1[2, k] + h1 * w1[2, k + 1] + h2 * w1[2, k + 2] + h3 * w1[2, k + 3]
    _sigmoid(out)


@compiled(merged=True)
def _from_feature(feature: Singles, by_feature: Singles, k: int) -> np.float32:
    total: np.float32 = feature[0] * by_feature[0, k]
    for i in range(1, len(feature)):
        total += feature[i] * by_feature[i, k]
    return total


@compiled()
def _first_layers(feature: Singles, mlp: SplitMlp, hidden: Singles) -> None:
    """Fill hidden[l % 2] with the units of the layer before the last, for l layers between the first and the last."""
    h, n = mlp.by_direction.shape
    zero = f32(0)
    for k in range(h):
        f = _from_feature(feature, mlp.by_feature, k)
        for j in range(n):
            unit = f + mlp.by_direction[k, j]
            hidden[0, k, j] = unit if unit > zero else zero
    for layer in range(len(mlp.middle)):
        x, y, weights = hidden[layer % 2], hidden[1 - layer % 2], mlp.middle[layer]
        for o in range(h):
            y[o] = mlp.middle_bias[layer, o]
            for k in range(0, h, 4):
                w0, w1, w2, w3 = weights[o, k], weights[o, k + 1], weights[o, k + 2], weights[o, k + 3]
                for j in range(n):
                    y[o, j] += x[k, j] * w0 + x[k + 1, j] * w1 + x[k + 2, j] * w2 + x[k + 3, j] * w3
            for j in range(n):
                y[o, j] = y[o, j] if y[o, j] > zero else zero


@compiled(merged=True)
def _sigmoid(x: Singles) -> None:
    """1 / (1 + e^-x) in place.

    e^-x = 2^k 2^r with an integer k: 2^k is k + 127 in a float's exponent bits, 2^r a polynomial.
    """
    bits = np.empty(x.size, np.int32)
    power = bits.view(np.float32)
    for j in range(x.size):
        t = -x[j] * _LOG2_E
        t = t if t > f32(-126) else f32(-126)
        t = t if t < f32(126) else f32(126)
        k = np.floor(t + f32(0.5))
        bits[j] = (np.int32(k) + _BIAS) << _MANTISSA
        r = t - k
        x[j] = f32(1) + r * (_C1 + r * (_C2 + r * (_C3 + r * (_C4 + r * _C5))))
    for j in range(x.size):
        x[j] = f32(1) / (f32(1) + power[j] * x[j])


@on_every_core
@compiled()
def _evaluate(core: int, cores: int, features: Singles, mlp: SplitMlp, out: Singles) -> None:
    features, mlp, out = borrowed((features, mlp, out))
    hidden = np.empty((2, *mlp.by_direction.shape), np.float32)
    begin, end = part_of(len(features), core, cores)
    for i in range(begin, end):
        _show(features[i], mlp, hidden, out[i])


@on_every_core
@compiled()
def _evaluate_each(
    core: int,
    cores: int,
    inputs: Singles,
    weights: Singles,
    biases: Singles,
    sizes: npt.NDArray[np.int64],
    out: Singles,
) -> None:
    inputs, weights, biases, sizes, out = borrowed((inputs, weights, biases, sizes, out))
    begin, end = part_of(len(inputs), core, cores)
    x, y = np.empty(weights.shape[1], np.float32), np.empty(weights.shape[1], np.float32)
    last = len(weights) - 1
    for i in range(begin, end):
        for j in range(sizes[0]):
            x[j] = inputs[i, j]
        for layer in range(last + 1):
            outputs = sizes[layer + 1]
            for k in range(outputs):
                y[k] = biases[layer, k]
            for j in range(sizes[layer]):
                for k in range(outputs):
                    y[k] += x[j] * weights[layer, j, k]
            if layer < last:
                for k in range(outputs):
                    y[k] = max(y[k], f32(0))
            x, y = y, x
        for channel in range(3):
            s, q = compiled_exp_parts(-np.float64(x[channel]))
            out[i, channel] = 1 / (1 + (s + s * q))


@on_every_core
@compiled()
def _project(
    core: int,
    cores: int,
    features: Singles,
    mlp: SplitMlp,
    basis: Singles,
    shift: Singles,
    out: Singles,
) -> None:
    features, mlp, basis, shift, out = borrowed((features, mlp, basis, shift, out))
    hidden = np.empty((2, *mlp.by_direction.shape), np.float32)
    n, p = basis.shape
    whole = n - n % 4
    begin, end = part_of(len(features), core, cores)
    for i in range(begin, end):
        output = np.empty(n, np.float32)
        _show(features[i], mlp, hidden, output)
        for q in range(p):
            out[i, q] = -shift[q]
        for j in range(0, whole, 4):
            a, b, c, d = output[j], output[j + 1], output[j + 2], output[j + 3]
            for q in range(p):
                out[i, q] += a * basis[j, q] + b * basis[j + 1, q] + c * basis[j + 2, q] + d * basis[j + 3, q]
        for j in range(whole, n):
            for q in range(p):
                out[i, q] += output[j] * basis[j, q]


@compiled(merged=True)
def _apart(
    truth: npt.NDArray[Any],
    table: Singles,
    index: npt.NDArray[np.int32],
    weight: Singles,
    half: np.float32,
    out: npt.NDArray[np.float64],
) -> None:
    n = len(truth)
    shown = np.zeros(n, np.float32)
    for t in range(len(index)):
        k, w = index[t], weight[t] * f32(255)
        for j in range(n):
            shown[j] += w * table[k, j]
    whole, whole_square = np.int32(0), np.int32(0)
    for j in range(n):
        seen, true = shown[j], truth[j] * f32(255)
        seen = seen if seen > f32(0) else f32(0)
        seen = seen if seen < f32(255) else f32(255)
        steps = np.int32(np.floor(true + half)) - np.int32(np.floor(seen + half))
        whole += abs(steps)
        whole_square += steps * steps
        shown[j] = true - seen
    # Four partial sums, always over the same terms.
    e0, e1, e2, e3 = f32(0), f32(0), f32(0), f32(0)
    s0, s1, s2, s3 = f32(0), f32(0), f32(0), f32(0)
    for j in range(0, n - n % 4, 4):
        a, b, c, d = shown[j], shown[j + 1], shown[j + 2], shown[j + 3]
        e0, e1, e2, e3 = e0 + abs(a), e1 + abs(b), e2 + abs(c), e3 + abs(d)
        s0, s1, s2, s3 = s0 + a * a, s1 + b * b, s2 + c * c, s3 + d * d
    for j in range(n - n % 4, n):
        e0, s0 = e0 + abs(shown[j]), s0 + shown[j] * shown[j]
    out[0], out[1], out[2], out[3] = whole, whole_square, (e0 + e1) + (e2 + e3), (s0 + s1) + (s2 + s3)


@on_every_core
@compiled()
def _differences(
    core: int,
    cores: int,
    features: Singles,
    mlp: SplitMlp,
    table: Singles,
    index: npt.NDArray[np.int32],
    weight: Singles,
    out: npt.NDArray[np.float64],
) -> None:
    features, mlp, table, index, weight, out = borrowed((features, mlp, table, index, weight, out))
    hidden = np.empty((2, *mlp.by_direction.shape), np.float32)
    begin, end = part_of(len(features), core, cores)
    for i in range(begin, end):
        truth = np.empty(table.shape[1], np.float32)
        _show(features[i], mlp, hidden, truth)
        _apart(truth, table, index[i], weight[i], f32(0.5), out[i])


@on_every_core
@compiled()
def _exact_differences(
    core: int,
    cores: int,
    by_feature: npt.NDArray[np.float64],
    by_direction: npt.NDArray[np.float64],
    w1: npt.NDArray[np.float64],
    table: Singles,
    index: npt.NDArray[np.int32],
    weight: Singles,
    out: npt.NDArray[np.float64],
) -> None:
    by_feature, by_direction, w1, table, index, weight, out = borrowed(
        (by_feature, by_direction, w1, table, index, weight, out)
    )
    hidden, n = by_direction.shape
    begin, end = part_of(len(by_feature), core, cores)
    for i in range(begin, end):
        truth = np.zeros(3 * n)
        for k in range(hidden):
            for j in range(n):
                h = max(by_feature[i, k] + by_direction[k, j], 0.0)
                truth[j] += h * w1[0, k]
                truth[n + j] += h * w1[1, k]
                truth[2 * n + j] += h * w1[2, k]
        for j in range(3 * n):
            s, q = compiled_exp_parts(-truth[j])
            truth[j] = 1 / (1 + (s + s * q))
        _apart(truth, table, index[i], weight[i], f32(0), out[i])
