"""Means over groups of as many rows each."""

from __future__ import annotations

import numpy as np
from numba import prange

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.jit import compiled


def weighted_means(values: Singles, weights: Floats, group: int) -> Singles:
    """(k, C) of values (k group, C), each row weighted (k group,), from a group's first row to its last; a group whose
    weights are all 0 is 0."""
    out = np.empty((len(values) // group, values.shape[1]), np.float32)
    _means(values, weights, group, out)
    return out


@compiled(parallel=True)
def _means(values: Singles, weights: Floats, group: int, out: Singles) -> None:
    for k in prange(len(out)):
        whole = 0.0
        for row in range(k * group, (k + 1) * group):
            whole += weights[row]
        for column in range(out.shape[1]):
            total = 0.0
            for row in range(k * group, (k + 1) * group):
                total += weights[row] * values[row, column]
            out[k, column] = total / whole if whole > 0 else 0.0
