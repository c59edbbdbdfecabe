"""Products of matrices, and what is made of them, with the same last bit on every CPU.

A BLAS orders its sums by the CPU and by its number of threads. Here every sum runs from the first term to the last;
what is done at once are sums that have nothing to do with each other.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.jit import compiled

_ROWS, _COLUMNS = 8, 256  # of a tile of the result: 16 KB stay in the first-level cache
_DEPENDENT = 1e-6  # of its length: a column that keeps less depends on those before it


def product(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> Floats:
    """a @ b of (m, k) and (k, n), in float64."""
    out = np.zeros((a.shape[0], b.shape[1]))
    _product(np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b), out)
    return out


def principal_axes(points: Floats, count: int, *, rounds: int = 4) -> Floats:
    """(d, count) orthonormal columns that span nearly all of what (m, d) points spread along, the most first.

    Orthogonal iteration, from a start that is always the same. Columns beyond the points' rank are zero.
    """
    axes = np.random.default_rng(0).random((points.shape[1], count)) - 0.5
    across = np.ascontiguousarray(points.T)
    for _ in range(rounds):
        axes = product(across, product(points, axes))
        _orthonormalise(axes)
    return axes


@compiled(parallel=True)
def _product(a: Floats, b: npt.NDArray[Any], out: Floats) -> None:
    m, n = out.shape
    wide = (n + _COLUMNS - 1) // _COLUMNS
    for tile in prange((m + _ROWS - 1) // _ROWS * wide):
        top, left = tile // wide * _ROWS, tile % wide * _COLUMNS
        right = min(left + _COLUMNS, n)
        for s in range(len(b)):
            terms = b[s, left:right]
            for i in range(top, min(top + _ROWS, m)):
                factor, total = a[i, s], out[i, left:right]
                for j in range(len(terms)):
                    total[j] += factor * terms[j]


@compiled()
def _orthonormalise(columns: Floats) -> None:
    """Gram and Schmidt's, each column twice, which is enough for all digits."""
    d, count = columns.shape
    for c in range(count):
        before = 0.0
        for i in range(d):
            before += columns[i, c] * columns[i, c]
        for _ in range(2):
            for other in range(c):
                shared = 0.0
                for i in range(d):
                    shared += columns[i, c] * columns[i, other]
                for i in range(d):
                    columns[i, c] -= shared * columns[i, other]
        after = 0.0
        for i in range(d):
            after += columns[i, c] * columns[i, c]
        held = after > 0 and after > before * _DEPENDENT * _DEPENDENT
        scale = 1 / np.sqrt(after) if held else 0.0
        for i in range(d):
            columns[i, c] *= scale
