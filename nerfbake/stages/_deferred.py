"""Deferred colours: a diffuse colour plus the output of an MLP that depends on the direction."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from nerfbake.kernels.arrays import Ints, Points, Singles
from nerfbake.kernels.lattice.harmonics import LEAST, inverse_of
from nerfbake.kernels.lattice.mlp import layers_for, logits_along
from nerfbake.kernels.march.sh import sh_basis
from nerfbake.kernels.maths.elementary import log, sigmoid
from nerfbake.kernels.maths.linear import product
from nerfbake.scene.lattice_field import DeferredColour

Seen = Callable[[Singles, Ints], Singles]
_THINNEST = np.float32(1e-6)  # smallest opacity that features are divided by


def diffuse_and_inputs(colour: DeferredColour, features: Singles) -> Singles:
    """Return the diffuse colour and the MLP's inputs (k, 3 + others) of features (k, C), without the opacity factor."""
    if colour.squashed:
        return sigmoid(features).astype(np.float32)
    return np.asarray(features[:, :-1] / np.maximum(features[:, -1:], _THINNEST), np.float32)


def colour_function(colour: DeferredColour, directions: Points) -> Seen:
    """A function of diffuse_and_inputs() (k, 3 + others) and indices (k,) into `directions` to colours (k, 3)."""
    if colour.mlp is None:
        return lambda values, ray: np.asarray(np.minimum(values[:, :3], 1), np.float32)
    layers = layers_for(directions, colour.mlp.frequencies, *colour.mlp.weights)

    def seen(values: Singles, ray: Ints) -> Singles:
        added = sigmoid(logits_along(values, layers, ray)).astype(np.float32)
        return np.asarray(np.minimum(values[:, :3] + added, 1), np.float32)

    return seen


def fit_of_deferred(colour: DeferredColour, directions: Points, B: int) -> Callable[[Singles], Singles]:
    """A function of diffuse_and_inputs() (m, 3 + others) to SH coefficients (m, 3 B) of colours behind a sigmoid.

    The coefficients are the least-squares fit of the colours' logits in these directions.
    """
    inverse, seen = inverse_of(sh_basis(directions, B)), colour_function(colour, directions)

    def fit(values: Singles) -> Singles:
        out = np.zeros((len(values), 3, B))
        for j in range(len(directions)):
            shown = np.clip(seen(values, np.full(len(values), j)), LEAST, 1 - LEAST).astype(np.float64)
            logits = log(shown) - log(1 - shown)
            out += product(logits.reshape(-1, 1), inverse[None, :, j]).reshape(out.shape)
        return out.reshape(len(values), -1).astype(np.float32)

    return fit
