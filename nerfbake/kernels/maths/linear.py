"""Matrix products, linear equations, factorisations and eigenvectors with the same last bit on every CPU.

BLAS and LAPACK order their sums by the CPU and by the number of threads. Here every sum runs from the first term to the
last; only independent sums are computed at the same time.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

_TILE_ROWS, _TILE_COLUMNS = 8, 256  # size of a tile of the result: its 16 KB stay in the first-level cache
_SMALL = 1_000_000  # multiplications: for fewer, a thread takes longer to start than to work
_DEPENDENT = 1e-6  # of its length: a column that keeps less is dependent on the previous ones


def product(a: npt.NDArray[Any], b: npt.NDArray[Any]) -> Floats:
    """a @ b for (m, k) and (k, n), in float64."""
    out = np.zeros((a.shape[0], b.shape[1]))
    terms = np.ascontiguousarray(a, np.float64), np.ascontiguousarray(b), out
    if a.size * b.shape[1] < _SMALL:
        _add_product(0, 1, *terms)
    else:
        on_every_core(_add_product)(*terms)
    return out


def principal_axes(points: Floats, count: int) -> Floats:
    """(d, count) orthonormal columns that span nearly all of the spread of (m, d) points, the largest first.

    Four rounds of orthogonal iteration from a fixed start. Columns beyond the rank of the points are zero.
    """
    axes = np.random.default_rng(0).random((points.shape[1], count)) - 0.5
    across = np.ascontiguousarray(points.T)
    for _ in range(4):
        axes = product(across, product(points, axes))
        _orthonormalise(axes)
    return axes


@compiled()
def _add_product(core: int, cores: int, a: Floats, b: npt.NDArray[Any], out: Floats) -> None:
    m, n = out.shape
    wide = (n + _TILE_COLUMNS - 1) // _TILE_COLUMNS
    for tile in range(core, (m + _TILE_ROWS - 1) // _TILE_ROWS * wide, cores):
        top, left = tile // wide * _TILE_ROWS, tile % wide * _TILE_COLUMNS
        right = min(left + _TILE_COLUMNS, n)
        for s in range(len(b)):
            terms = b[s, left:right]
            for i in range(top, min(top + _TILE_ROWS, m)):
                factor, total = a[i, s], out[i, left:right]
                for j in range(len(terms)):
                    total[j] += factor * terms[j]


@compiled()
def _orthonormalise(columns: Floats) -> None:
    """Gram-Schmidt, in place. Each column is processed twice, which is enough for full precision."""
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


_COLUMNS = 64  # right-hand sides that a core processes at a time


def solve_each(left: Floats, right: Floats) -> Floats:
    """x (K, c, p) of left x = right for K small systems, (K, c, c) and (K, c, p), by Gaussian elimination."""
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
    """x (n, p) of left x = right (n, p), where left is symmetric, positive definite and banded.

    band (n, w): left[i, i - k] = left[i - k, i] = band[i, k], and 0 for k >= w. The Cholesky factor stays within the
    band.
    """
    factor, x = band.copy(), right.copy()
    _factorise(factor)
    _substitute(factor, x)
    return x


@compiled()
def _factorise(band: Floats) -> None:
    """Cholesky factorisation left = L L^T; L overwrites left."""
    n, w = band.shape
    for i in range(n):
        first = max(0, i - w + 1)
        for j in range(first, i + 1):
            total = band[i, i - j]
            for k in range(max(first, j - w + 1), j):
                total -= band[i, i - k] * band[j, j - k]
            band[i, i - j] = np.sqrt(total) if i == j else total / band[j, 0]


@on_every_core
@compiled()
def _substitute(core: int, cores: int, band: Floats, x: Floats) -> None:
    n, w = band.shape
    for part in range(core, (x.shape[1] + _COLUMNS - 1) // _COLUMNS, cores):
        # A contiguous copy: 64 columns of 2,197 rows are 1.1 MB.
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
        for i in range(n):
            for t in range(own.shape[1]):
                x[i, part * _COLUMNS + t] = own[i, t]


_SWEEPS = 40  # at most; eight are usual


def cholesky(matrix: Floats) -> Floats:
    """The lower triangular L with L L^T = matrix (c, c), which must be symmetric and positive definite."""
    L = np.zeros_like(matrix)
    for j in range(len(matrix)):
        for i in range(j, len(matrix)):
            total = matrix[i, j]
            for k in range(j):
                total = total - L[i, k] * L[j, k]
            L[i, j] = np.sqrt(total) if i == j else total / L[j, j]
    return L


def eigenvectors(matrix: Floats) -> tuple[Floats, Floats]:
    """(c,) eigenvalues of a symmetric matrix (c, c) in descending order, and (c, c) eigenvectors as columns.

    Jacobi rotations, row by row. The largest entry of each vector is positive.
    """
    turned, vectors = matrix.copy(), np.eye(len(matrix))
    diagonalise(turned, vectors)
    values = np.diagonal(turned)
    order = np.argsort(-values, kind="stable")
    vectors = vectors[:, order]
    largest = np.argmax(np.abs(vectors), axis=0)
    signs = np.where(vectors[largest, np.arange(len(order))] < 0, -1.0, 1.0)
    return values[order], vectors * signs


@compiled()
def diagonalise(a: Floats, vectors: Floats) -> None:
    """Rotate the matrix until its off-diagonal entries vanish, and the vectors with it."""
    n = len(a)
    for _ in range(_SWEEPS):
        beside, whole = 0.0, 0.0
        for i in range(n):
            for j in range(n):
                whole += a[i, j] * a[i, j]
                if i != j:
                    beside += a[i, j] * a[i, j]
        if beside <= 1e-30 * whole:
            return
        for p in range(n - 1):
            for q in range(p + 1, n):
                if a[p, q] == 0:
                    continue
                theta = (a[q, q] - a[p, p]) / (2 * a[p, q])
                t = 1 / (abs(theta) + np.sqrt(theta * theta + 1))
                if theta < 0:
                    t = -t
                c = 1 / np.sqrt(t * t + 1)
                s = t * c
                for k in range(n):
                    low, high = a[k, p], a[k, q]
                    a[k, p], a[k, q] = c * low - s * high, s * low + c * high
                for k in range(n):
                    low, high = a[p, k], a[q, k]
                    a[p, k], a[q, k] = c * low - s * high, s * low + c * high
                for k in range(n):
                    low, high = vectors[k, p], vectors[k, q]
                    vectors[k, p], vectors[k, q] = c * low - s * high, s * low + c * high
