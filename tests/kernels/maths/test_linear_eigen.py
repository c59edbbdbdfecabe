from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from nerfbake.kernels.maths.linear import cholesky, eigenvectors


def test_a_turned_ellipse_by_hand() -> None:
    values, vectors = eigenvectors(np.array([[2.0, 1.0], [1.0, 2.0]]))
    assert_allclose(values, [3, 1])
    assert_allclose(np.abs(vectors), np.sqrt(0.5))
    assert vectors[0, 0] * vectors[1, 0] > 0 > vectors[0, 1] * vectors[1, 1]


@given(st.integers(0, 2**32), st.integers(1, 30))
def test_they_are_what_lapack_finds(seed: int, n: int) -> None:
    a = np.random.default_rng(seed).normal(size=(n, n + 2))
    matrix = a @ a.T
    values, vectors = eigenvectors(matrix)
    assert_allclose(values, np.linalg.eigvalsh(matrix)[::-1], rtol=1e-9, atol=1e-9)
    assert_allclose(vectors.T @ vectors, np.eye(n), atol=1e-12)
    assert_allclose(vectors * values @ vectors.T, matrix, atol=1e-9)
    assert_allclose(cholesky(matrix), np.linalg.cholesky(matrix), rtol=1e-6, atol=1e-9)


def test_equal_and_empty_directions_are_no_trouble() -> None:
    values, vectors = eigenvectors(np.diag([0.0, 5.0, 5.0, 0.0]))
    assert values.tolist() == [5, 5, 0, 0]
    assert_allclose(vectors.T @ vectors, np.eye(4))
