"""Symmetric, positive definite equations, solved with the same last bit on every CPU, as LAPACK would not."""

from __future__ import annotations

import numpy as np
from numba import prange

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.jit import compiled

_COLUMNS = 64  # of right sides that a core takes at a time


def solve_each(left: Floats, right: Floats) -> Floats:
    """(K, c, p): x of left x = right for each of K small systems, (K, c, c) and (K, c, p); by elimination."""
    left, x = left.copy(), right.copy()
    c = left.shape[1]
    for j in range(c):
        for i in range(j + 1, c):
            share = (left[:, i, j] / left[:, j, j])[:, None]
            left[:, i] -= share * left[:, j]
            x[:, i] -= share * x[:, j]
    for j in reversed(range(c)):
        for i in range(j + 1, c):
            x[:, j] -= left[:, j, i, None] * x[:, i]
        x[:, j] /= left[:, j, j, None]
    return x


def solve_banded(band: Floats, right: Floats) -> Floats:
    """(n, p): x of left x = right (n, p) where left[i, i - k] = left[i - k, i] = band[i, k], and 0 from k = w on.

    band (n, w). Cholesky's factors stay within the band.
    """
    factor, x = band.copy(), right.copy()
    _factorise(factor)
    _substitute(factor, x)
    return x


@compiled()
def _factorise(band: Floats) -> None:
    """left = L L^T, L in the place of left."""
    n, w = band.shape
    for i in range(n):
        first = max(0, i - w + 1)
        for j in range(first, i + 1):
            total = band[i, i - j]
            for k in range(max(first, j - w + 1), j):
                total -= band[i, i - k] * band[j, j - k]
            band[i, i - j] = np.sqrt(total) if i == j else total / band[j, 0]


@compiled(parallel=True)
def _substitute(band: Floats, x: Floats) -> None:
    n, w = band.shape
    for part in prange((x.shape[1] + _COLUMNS - 1) // _COLUMNS):
        # A copy that lies together: 64 columns of 2,197 rows are 1.1 MB.
        own = x[:, part * _COLUMNS : (part + 1) * _COLUMNS].copy()
        for i in range(n):
            for k in range(max(0, i - w + 1), i):
                factor = band[i, i - k]
                for t in range(own.shape[1]):
                    own[i, t] -= factor * own[k, t]
            for t in range(own.shape[1]):
                own[i, t] /= band[i, 0]
        for i in range(n - 1, -1, -1):
            for t in range(own.shape[1]):
                own[i, t] /= band[i, 0]
            for k in range(max(0, i - w + 1), i):
                factor = band[i, i - k]
                for t in range(own.shape[1]):
                    own[k, t] -= factor * own[i, t]
        x[:, part * _COLUMNS : (part + 1) * _COLUMNS] = own
