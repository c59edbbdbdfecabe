"""Three by three matrices, with the same last bit on every CPU: a BLAS adds up as it likes, and these are short."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats


def turned(vectors: npt.NDArray[Any], matrix: Floats) -> Floats:
    """(..., 3) matrix @ each vector, matrix (3, 3): x of the first column, then y, then z of the others."""
    x, y, z = (vectors[..., axis, None] * matrix[:, axis] for axis in range(3))
    return np.asarray(x + y + z, np.float64)


def placed(points: npt.NDArray[Any], matrix: Floats) -> Floats:
    """(..., 3) points through a matrix (3, 4) or (4, 4), whose last column is where the origin goes."""
    return turned(points, matrix[:3, :3]) + matrix[:3, 3]


def combined(first: Floats, second: Floats) -> Floats:
    """first @ second, of small matrices."""
    return np.asarray((first[:, :, None] * second).sum(axis=1), np.float64)


def determinant(matrix: Floats) -> float:
    a, b, c = matrix
    return float((a * np.cross(b, c)).sum())


def inverse(matrix: Floats) -> Floats:
    """Of a matrix that has one, else what is not finite; of a diagonal one exactly its entries' reciprocals.

    Gauss and Jordan's elimination, with pivots.
    """
    rows = np.column_stack([matrix, np.eye(3)])
    for i in range(3):
        pivot = i + int(np.argmax(np.abs(rows[i:, i])))
        rows[[i, pivot]] = rows[[pivot, i]]
        rows[i] /= rows[i, i]
        for k in {0, 1, 2} - {i}:
            rows[k] -= rows[k, i] * rows[i]
    return rows[:, 3:]


def length(vector: Floats) -> float:
    return float(np.sqrt((vector * vector).sum()))
