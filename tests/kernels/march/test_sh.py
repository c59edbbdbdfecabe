from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose

from nerfbake.kernels.march.sh import band_of, rotation_of_sh, sh_basis


def test_the_basis_is_orthonormal() -> None:
    # Gauss-Legendre in z times even steps around: exact for products of two bands up to 4.
    z, weight = np.polynomial.legendre.leggauss(8)
    angle = np.arange(16) * np.pi / 8
    z, angle = (grid.ravel() for grid in np.meshgrid(z, angle, indexing="ij"))
    flat = np.sqrt(1 - z * z)
    basis = sh_basis(np.stack([flat * np.cos(angle), flat * np.sin(angle), z], axis=1), 25)
    gram = basis.T @ (basis * (np.repeat(weight, 16) * np.pi / 8)[:, None])
    assert_allclose(gram, np.eye(25), atol=1e-12)


def test_the_first_terms_are_svox_ones() -> None:
    d = np.array([[0.36, -0.48, 0.8]])
    x, y, z = d[0]
    expected = [0.28209479, -0.48860251 * y, 0.48860251 * z, -0.48860251 * x, 1.09254843 * x * y]
    expected += [-1.09254843 * y * z, 0.31539157 * (2 * z * z - x * x - y * y), -1.09254843 * x * z]
    expected += [0.54627422 * (x * x - y * y)]
    assert_allclose(sh_basis(d, 9)[0], expected, rtol=1e-7)


def test_signs_of_the_higher_bands() -> None:
    # Every band turned around z keeps its sign pattern: f_l^-m is positive where sin(m phi) (-1)^m is, near the pole.
    d = np.array([[0.1 * np.cos(0.3), 0.1 * np.sin(0.3), np.sqrt(0.99)]])
    basis = sh_basis(d, 25)[0]
    for band in (1, 2, 3, 4):
        for m in range(1, band + 1):
            sign = (-1) ** m
            assert basis[band * band + band - m] * sign > 0, (band, -m)
            assert basis[band * band + band + m] * sign > 0, (band, m)


def test_bands() -> None:
    assert band_of(9).tolist() == [0, 1, 1, 1, 2, 2, 2, 2, 2]


def test_rotations_of_coefficients_compose_and_keep_lengths() -> None:
    random = np.random.default_rng(2)
    first, second = (np.linalg.qr(random.normal(size=(3, 3)))[0] for _ in range(2))
    both = rotation_of_sh(first, 25) @ rotation_of_sh(second, 25)
    assert_allclose(rotation_of_sh(first @ second, 25), both, atol=1e-11)
    assert_allclose(both @ both.T, np.eye(25), atol=1e-11)
    assert np.array_equal(rotation_of_sh(np.eye(3), 25), np.eye(25))
