"""Short products of (3,) vectors and (3, 3) or (3, 4) matrices in NumPy alone, the same on every CPU.

This module does not import numba, so that commands that read and check files start fast.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats


def rotate(vectors: npt.NDArray[Any], matrix: Floats) -> Floats:
    """matrix @ vector for (..., 3) vectors and a (3, 3) matrix.

    The terms are added in order: x times the first column, y times the second, z times the third.
    """
    x, y, z = (vectors[..., axis, None] * matrix[:, axis] for axis in range(3))
    return np.asarray(x + y + z, np.float64)


def transform_points(points: npt.NDArray[Any], matrix: Floats) -> Floats:
    """Transform (..., 3) points by a (3, 4) or (4, 4) matrix, whose last column is the translation."""
    return rotate(points, matrix[:3, :3]) + matrix[:3, 3]


def compose(first: Floats, second: Floats) -> Floats:
    """first @ second, for small matrices."""
    return np.asarray((first[:, :, None] * second).sum(axis=1), np.float64)


def determinant(matrix: Floats) -> float:
    a, b, c = matrix
    return float((a * np.cross(b, c)).sum())


def inverse(matrix: Floats) -> Floats:
    """The inverse of a square matrix, by Gauss-Jordan elimination with pivots.

    A singular matrix gives values that are not finite. For a diagonal matrix the entries are exactly the reciprocals.
    """
    n = len(matrix)
    rows = np.column_stack([matrix, np.eye(n)])
    for i in range(n):
        pivot = i + int(np.argmax(np.abs(rows[i:, i])))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] /= rows[i, i]
        for k in {*range(n)} - {i}:
            rows[k] -= rows[k, i] * rows[i]
    return rows[:, n:]


def length(vector: Floats) -> float:
    return float(np.sqrt((vector * vector).sum()))
