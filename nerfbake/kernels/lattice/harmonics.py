"""Colours as sums of spherical harmonics clamped at 0: their evaluation, and their conversion to sums behind a sigmoid.

The coefficients behind the sigmoid are the least-squares fit, over a set of directions, to the logit of the colour: one
product with a matrix that is the same for all colours. Lanes are colours, so every loop over lanes is vectorised and
every sum has one order.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles, f32
from nerfbake.kernels.jit import compiled, part_of
from nerfbake.kernels.maths.linear import product, solve_each
from nerfbake.kernels.parallel import on_every_core

LEAST = 1 / 510  # half of the smallest colour in 8 bits: logits nearer to 0 and 1 make no visible difference
_LANES = 64
_LN2 = f32(0.6931471805599453)
_ROOT_HALF = np.int32(0x3F3504F3)  # the bits of sqrt(1/2)
_MANTISSA = np.int32(23)


def inverse_of(basis: Floats) -> Singles:
    """(B, n) matrix from values in n directions to least-squares coefficients; basis (n, B), of full rank."""
    across = np.ascontiguousarray(basis.T)
    return np.asarray(solve_each(product(across, basis)[None], across[None])[0], np.float32)


def evaluate_colours(features: Singles, basis: Singles, ray: Ints) -> Singles:
    """(k, 3) colours of features (k, 3 B), each in the direction of its ray: basis (m, B), ray (k,)."""
    out = np.empty((len(features), 3), np.float32)
    _show(features, basis, ray, out)
    return out


def refit_coefficients(features: Singles, basis: Singles, inverse: Singles) -> Singles:
    """(m, 3 B') coefficients behind a sigmoid for features (m, 3 B).

    basis (n, B): the basis of the features in the directions of the fit; inverse (B', n): inverse_of() the other basis
    in the same directions.
    """
    pairs = np.ascontiguousarray(features).reshape(-1, basis.shape[1])
    out = np.empty((len(pairs), len(inverse)), np.float32)
    _refit(pairs, basis, inverse, out)
    return out.reshape(len(features), -1)


@on_every_core
@compiled()
def _show(core: int, cores: int, features: Singles, basis: Singles, ray: Ints, out: Singles) -> None:
    B = basis.shape[1]
    begin, end = part_of(len(features), core, cores)
    for i in range(begin, end):
        own = basis[ray[i]]
        for channel in range(3):
            total = f32(0.5)
            for b in range(B):
                total += own[b] * features[i, channel * B + b]
            out[i, channel] = max(total, f32(0))


@on_every_core
@compiled()
def _refit(core: int, cores: int, pairs: Singles, basis: Singles, inverse: Singles, out: Singles) -> None:
    p, B = pairs.shape
    lowest, highest = f32(LEAST), f32(1 - LEAST)
    for block in range(core, (p + _LANES - 1) // _LANES, cores):
        begin, end = block * _LANES, min((block + 1) * _LANES, p)
        own, sums = np.zeros((B, _LANES), np.float32), np.zeros((len(inverse), _LANES), np.float32)
        x, powers = np.empty(_LANES, np.float32), np.empty(_LANES, np.int32)
        for lane in range(end - begin):
            for b in range(B):
                own[b, lane] = pairs[begin + lane, b]
        for j in range(len(basis)):
            x[:] = f32(0.5)
            for b in range(B):
                y, row = basis[j, b], own[b]
                for lane in range(_LANES):
                    x[lane] += y * row[lane]
            for lane in range(_LANES):
                colour = min(max(x[lane], lowest), highest)
                x[lane] = colour / (f32(1) - colour)
            log_lanes(x, powers)
            for k in range(len(inverse)):
                share, total = inverse[k, j], sums[k]
                for lane in range(_LANES):
                    total[lane] += share * x[lane]
        for lane in range(end - begin):
            for k in range(len(inverse)):
                out[begin + lane, k] = sums[k, lane]


@compiled(inline=True)
def log_lanes(x: Singles, powers: npt.NDArray[np.int32]) -> None:
    """The natural logarithm of positive, normal numbers, in place.

    x = 2^k m, m from sqrt(1/2) to sqrt(2), and ln m = 2 artanh((m - 1) / (m + 1)).
    """
    bits = x.view(np.int32)
    for lane in range(len(x)):
        k = (bits[lane] - _ROOT_HALF) >> _MANTISSA
        bits[lane] -= k << _MANTISSA
        powers[lane] = k
    for lane in range(len(x)):
        s = (x[lane] - f32(1)) / (x[lane] + f32(1))
        z = s * s
        series = f32(1) + z * (f32(1 / 3) + z * (f32(1 / 5) + z * (f32(1 / 7) + z * f32(1 / 9))))
        x[lane] = f32(powers[lane]) * _LN2 + f32(2) * s * series
