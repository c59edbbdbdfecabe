"""Eigenvectors and triangular factors of symmetric matrices, with the same last bit on every CPU, unlike LAPACK's."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.jit import compiled

Floats = npt.NDArray[np.float64]

_SWEEPS = 40  # eight are usual


def cholesky(matrix: Floats) -> Floats:
    """The lower triangle L with L L^T = matrix (c, c), which is symmetric and positive definite."""
    L = np.zeros_like(matrix)
    for j in range(len(matrix)):
        for i in range(j, len(matrix)):
            total = matrix[i, j]
            for k in range(j):
                total = total - L[i, k] * L[j, k]
            L[i, j] = np.sqrt(total) if i == j else total / L[j, j]
    return L


def eigenvectors(matrix: Floats) -> tuple[Floats, Floats]:
    """(c,) falling eigenvalues of a symmetric matrix (c, c), and (c, c) its eigenvectors, a column each.

    Jacobi's rotations, row by row. The largest entry of each vector is positive.
    """
    turned, vectors = matrix.copy(), np.eye(len(matrix))
    _rotate(turned, vectors)
    values = np.diagonal(turned)
    order = np.argsort(-values, kind="stable")
    vectors = vectors[:, order]
    largest = np.argmax(np.abs(vectors), axis=0)
    signs = np.where(vectors[largest, np.arange(len(order))] < 0, -1.0, 1.0)
    return values[order], vectors * signs


@compiled()
def _rotate(a: Floats, vectors: Floats) -> None:
    """Turns the matrix until nothing is left beside its diagonal, and the vectors with it."""
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
