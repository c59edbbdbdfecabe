"""Colours in every direction as features and an MLP that makes colours of them again."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.lattice.mlp import encoded
from nerfbake.kernels.lattice.training import Pairs, fitted
from nerfbake.kernels.maths.products import principal_axes, product
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.scene.lattice_colour import MlpColour
from nerfbake.scene.radiance_field import RadianceField
from nerfbake.stages._basis_functions import basis_at

# What PlenVDB trains by itself, and what its fast renderer takes for granted.
FEATURES, UNITS = 12, 128
FREQUENCIES = (1.0, 2.0, 4.0, 8.0)

# Of the real chair at 256^3: 12 features along the colours' principal axes alone, without an MLP behind them, would be
# 4.2/255 off (RMS); the MLP is 4.6 off after 1,000 rounds, 3.7 after 3,000.
ROUNDS = 3000
_ROWS, _DIRECTIONS = 1 << 16, 1 << 13  # that the MLP is shown
_SEEN_BY_NOBODY = 1 / 64  # how likely a leaf is to be among them, by one that nothing hides
_CHUNK = 1 << 15


class Code(NamedTuple):
    """Features are (coefficients - mean) @ axes: mean (3 B,), axes (3 B, 12), along the most spread first."""

    mean: Floats
    axes: Floats

    def features(self, coefficients: npt.NDArray[np.generic]) -> Singles:
        """(m, 12) of coefficients (m, 3 B)."""
        out = np.empty((len(coefficients), FEATURES), np.float32)
        for begin in range(0, len(out), _CHUNK):
            apart = coefficients[begin : begin + _CHUNK].astype(np.float64) - self.mean
            out[begin : begin + _CHUNK] = product(apart, self.axes)
        return out


def fit_mlp(field: RadianceField, seen: Singles, *, rounds: int, seed: int) -> tuple[Code, MlpColour]:
    """What makes features of a field's colours, and what makes colours of those again.

    seen: (leaves,) how much of each leaf there is to be seen, 0 to 1. That often the MLP, of two hidden layers of 128
    units, is shown the leaf, in directions all over the sphere.
    """
    random = np.random.default_rng(seed)
    coefficients = field.values[_drawn(seen, random), :-1]
    code = _code(coefficients.astype(np.float64))
    directions = fibonacci(_DIRECTIONS)
    inputs = encoded(directions, FREQUENCIES).astype(np.float32)
    basis = basis_at(field.basis, directions, np.float32)
    pairs = Pairs(code.features(coefficients), coefficients, inputs, basis)
    weights = fitted(pairs, UNITS, rounds=rounds, seed=seed)
    layers = weights.first, weights.first_bias, weights.middle[None], weights.middle_bias[None]
    return code, MlpColour(*layers, weights.last, weights.last_bias, FREQUENCIES)


def _drawn(seen: Singles, random: np.random.Generator) -> Ints:
    """(_ROWS,) rows, those that are seen more often than others."""
    upto = np.cumsum(seen.astype(np.float64) + _SEEN_BY_NOBODY)
    rows: Ints = np.searchsorted(upto, random.random(_ROWS) * upto[-1])
    return np.minimum(rows, len(seen) - 1)


def _code(coefficients: Floats) -> Code:
    """Features of mean 0 and mean square 1 each.

    Where there is nothing left to tell, they are the first one again: PlenVDB wants as many leaves in each of its
    colour grids, and a grid of zeros has none.
    """
    count = len(coefficients)
    ones = np.full((1, count), 1 / count)
    mean = product(ones, coefficients)[0]
    apart = coefficients - mean
    axes = np.zeros((len(mean), FEATURES))
    told = min(FEATURES, len(mean))
    axes[:, :told] = principal_axes(apart, told)
    square = product(ones, product(apart, axes) ** 2)[0]
    square[told:] = 0
    axes *= np.where(square > 0, 1 / np.sqrt(np.where(square > 0, square, 1)), 0)
    axes[:, square == 0] = axes[:, :1]
    return Code(mean, axes)
