"""nerf2mesh's specular MLP for many colours in many directions: sigmoid(relu([d, f] W0) W1), no biases.

The first layer is linear before its relu, so it splits: d W0[:3] is computed once a direction, f W0[3:] once a colour,
and what is left for each pair is one addition a hidden unit. The fast version runs over the directions of a colour in
vector registers, four hidden units a pass, with an exponential of its own: 143 million pairs (1.43 million colours,
100 directions, 32 hidden units) take 0.47 s on 2 cores of an AMD EPYC with AVX-512, 2.8 s written the plain way.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.jit import compiled

Array = npt.NDArray[np.float32]
f32 = np.float32

_LOG2_E = f32(np.log2(np.e))
# 2^r for r in [-1/2, 1/2], interpolated at Chebyshev points: relative error 1.1e-7.
_POWERS = np.polynomial.chebyshev.Chebyshev.interpolate(lambda r: 2.0**r, 5, domain=[-0.5, 0.5])
_C0, _C1, _C2, _C3, _C4, _C5 = (f32(c) for c in _POWERS.convert(kind=np.polynomial.Polynomial).coef)
_BIAS, _MANTISSA = np.int32(127), np.int32(23)


def evaluate(features: npt.NDArray[Any], directions: npt.NDArray[Any], w0: Array, w1: Array) -> Array:
    """The specular colours in 0..1: (m, 3) features in 0..1, (n, 3) unit directions -> (m, 3, n), colours by channel.

    w0 (6, h), rows 0 to 2 for the direction; w1 (h, 3). Weights must be finite. Within 1e-6 of exact arithmetic for
    weights of the size that training gives.
    """
    padding = -w0.shape[1] % 4  # whole passes of four; units of weight zero change nothing
    w0, w1 = np.pad(w0, ((0, 0), (0, padding))), np.pad(w1, ((0, padding), (0, 0)))
    by_direction = np.ascontiguousarray((directions @ w0[:3].astype(np.float64)).T, np.float32)
    out = np.empty((len(features), 3, len(directions)), np.float32)
    by_feature = np.ascontiguousarray(w0[3:])
    _evaluate(features.astype(np.float32), by_direction, by_feature, np.ascontiguousarray(w1.T), out)
    return out


def evaluate_exactly(
    features: npt.NDArray[Any], directions: npt.NDArray[Any], w0: npt.NDArray[Any], w1: npt.NDArray[Any]
) -> npt.NDArray[np.float64]:
    """Like evaluate(), in float64 throughout: the reference, and for figures that hang on truncation."""
    by_direction = np.ascontiguousarray((directions @ w0[:3].astype(np.float64)).T)
    by_feature = features.astype(np.float64) @ w0[3:].astype(np.float64)
    out = np.zeros((len(features), 3, len(directions)))
    _evaluate_exactly(by_feature, by_direction, np.ascontiguousarray(w1.T, np.float64), out)
    return out


@compiled(parallel=True, fastmath=True)
def _evaluate(features: Array, by_direction: Array, w0: Array, w1: Array, out: Array) -> None:
    m, n, hidden = len(features), by_direction.shape[1], len(by_direction)
    zero = f32(0)
    for i in prange(m):
        r, g, b = features[i, 0], features[i, 1], features[i, 2]
        total = np.zeros((3, n), np.float32)
        for k in range(0, hidden, 4):
            f0 = r * w0[0, k] + g * w0[1, k] + b * w0[2, k]
            f1 = r * w0[0, k + 1] + g * w0[1, k + 1] + b * w0[2, k + 1]
            f2 = r * w0[0, k + 2] + g * w0[1, k + 2] + b * w0[2, k + 2]
            f3 = r * w0[0, k + 3] + g * w0[1, k + 3] + b * w0[2, k + 3]
            for j in range(n):
                h0, h1 = max(f0 + by_direction[k, j], zero), max(f1 + by_direction[k + 1, j], zero)
                h2, h3 = max(f2 + by_direction[k + 2, j], zero), max(f3 + by_direction[k + 3, j], zero)
                total[0, j] += h0 * w1[0, k] + h1 * w1[0, k + 1] + h2 * w1[0, k + 2] + h3 * w1[0, k + 3]
                total[1, j] += h0 * w1[1, k] + h1 * w1[1, k + 1] + h2 * w1[1, k + 2] + h3 * w1[1, k + 3]
                total[2, j] += h0 * w1[2, k] + h1 * w1[2, k + 1] + h2 * w1[2, k + 2] + h3 * w1[2, k + 3]
        _sigmoid(total.reshape(-1), out[i].reshape(-1))


@compiled(fastmath=True, inline=True)
def _sigmoid(x: Array, out: Array) -> None:
    """1 / (1 + e^-x). e^-x = 2^k 2^r with k whole: 2^k is k + 127 in a float's exponent bits, 2^r a polynomial."""
    bits = np.empty(x.size, np.int32)
    whole = bits.view(np.float32)
    for j in range(x.size):
        t = min(max(-x[j] * _LOG2_E, f32(-126)), f32(126))
        k = np.floor(t + f32(0.5))
        bits[j] = (np.int32(k) + _BIAS) << _MANTISSA
        r = t - k
        out[j] = _C0 + r * (_C1 + r * (_C2 + r * (_C3 + r * (_C4 + r * _C5))))
    for j in range(x.size):
        out[j] = f32(1) / (f32(1) + whole[j] * out[j])


@compiled(parallel=True)
def _evaluate_exactly(
    by_feature: npt.NDArray[np.float64],
    by_direction: npt.NDArray[np.float64],
    w1: npt.NDArray[np.float64],
    out: npt.NDArray[np.float64],
) -> None:
    for i in prange(len(by_feature)):
        for k in range(len(by_direction)):
            for j in range(by_direction.shape[1]):
                h = max(by_feature[i, k] + by_direction[k, j], 0.0)
                out[i, 0, j] += h * w1[0, k]
                out[i, 1, j] += h * w1[1, k]
                out[i, 2, j] += h * w1[2, k]
        for channel in range(3):
            for j in range(by_direction.shape[1]):
                out[i, channel, j] = 1 / (1 + np.exp(-out[i, channel, j]))


@compiled(parallel=True, fastmath=True)
def project(identifiers: Array, basis: Array, shift: Array, out: Array) -> None:
    """out = identifiers @ basis - shift: (m, n), (n, p), (p,) -> (m, p), in an order that no thread count changes."""
    n, p = basis.shape
    whole = n - n % 4
    for i in prange(len(identifiers)):
        total = -shift
        for j in range(0, whole, 4):
            a, b, c, d = identifiers[i, j], identifiers[i, j + 1], identifiers[i, j + 2], identifiers[i, j + 3]
            for q in range(p):
                total[q] += a * basis[j, q] + b * basis[j + 1, q] + c * basis[j + 2, q] + d * basis[j + 3, q]
        for j in range(whole, n):
            total += identifiers[i, j] * basis[j]
        out[i] = total


@compiled(parallel=True)
def compare(
    truth: npt.NDArray[Any],
    table: Array,
    index: npt.NDArray[np.int32],
    weight: Array,
    half: np.float32,
    out: npt.NDArray[np.float64],
) -> None:
    """How far shown colours are from true ones, in units of 1/255, summed over channels and directions.

    truth (m, n) in 0..1; row i shows sum over t of weight[i, t] table[index[i, t]]; index (m, t), table (T, n).
    out (m, 4): |difference| and its square of whole numbers, then of the numbers as they are; half is 0.5 to round and
    0 to truncate.
    """
    n, terms = truth.shape[1], index.shape[1]
    for i in prange(len(truth)):
        shown = np.zeros(n, np.float32)
        for t in range(terms):
            k, w = index[i, t], weight[i, t] * f32(255)
            for j in range(n):
                shown[j] += w * table[k, j]
        whole, whole_square, exact, exact_square = 0.0, 0.0, 0.0, 0.0
        for j in range(n):
            seen, true = min(max(shown[j], f32(0)), f32(255)), truth[i, j] * f32(255)
            apart = np.floor(true + half) - np.floor(seen + half)
            whole += abs(apart)
            whole_square += apart * apart
            apart = true - seen
            exact += abs(apart)
            exact_square += apart * apart
        out[i, 0], out[i, 1], out[i, 2], out[i, 3] = whole, whole_square, exact, exact_square
