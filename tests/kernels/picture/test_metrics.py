from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.kernels.picture.metrics import IDENTICAL, psnr, ssim


def noise(seed: int = 0, shape: tuple[int, ...] = (24, 30, 3)) -> npt.NDArray[np.float64]:
    return np.random.default_rng(seed).uniform(0.2, 0.8, shape)


def test_psnr_by_hand() -> None:
    a = noise()
    assert psnr(a, a + 0.1) == pytest.approx(20)
    assert psnr(a, a + 0.01) == pytest.approx(40)
    assert psnr(a, a) == IDENTICAL


def test_ssim_of_equal_pictures_is_1_and_falls_with_noise() -> None:
    a = noise()
    found = [ssim(a, a + amount * noise(1)) for amount in (0, 0.01, 0.1, 1)]
    assert found[0] == pytest.approx(1)
    assert found == sorted(found, reverse=True)


def test_ssim_of_flat_pictures_is_their_luminance_term() -> None:
    a, b = np.full((20, 20, 3), 0.5), np.full((20, 20, 3), 0.25)
    assert ssim(a, b) == pytest.approx((2 * 0.5 * 0.25 + 1e-4) / (0.5**2 + 0.25**2 + 1e-4))


def test_ssim_with_one_window_is_the_formula() -> None:
    # 11 x 11 pixels hold one window: weights, means, variances and covariance by hand.
    a, b = noise(0, (11, 11, 3)), noise(1, (11, 11, 3))
    x = np.exp(-0.5 * ((np.arange(11) - 5) / 1.5) ** 2)
    weight = (np.outer(x, x) / x.sum() ** 2)[..., None]
    mean_a, mean_b = (weight * a).sum((0, 1)), (weight * b).sum((0, 1))
    var_a, var_b = (weight * (a - mean_a) ** 2).sum((0, 1)), (weight * (b - mean_b) ** 2).sum((0, 1))
    both = (weight * (a - mean_a) * (b - mean_b)).sum((0, 1))
    expected = (2 * mean_a * mean_b + 1e-4) * (2 * both + 9e-4)
    expected /= (mean_a**2 + mean_b**2 + 1e-4) * (var_a + var_b + 9e-4)
    assert ssim(a, b) == pytest.approx(expected.mean())
    assert ssim(a[:4, :7], b[:4, :7]) < 1


def test_ssim_is_the_same_in_bands(monkeypatch: pytest.MonkeyPatch) -> None:
    a = np.random.default_rng(0).random((75, 20, 3))
    found = ssim(a, a * a)
    monkeypatch.setattr("nerfbake.kernels.picture.metrics._BAND", 75)
    assert ssim(a, a * a) == found
