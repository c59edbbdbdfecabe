"""How far two pictures are apart."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import exp, log

IDENTICAL = 100.0  # dB: what equal pictures count as, since a mean over views must stay a number
_LN_10 = 2.302585092994046
_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(a: Floats, b: Floats) -> float:
    """Peak signal-to-noise ratio of (H, W, 3) in 0..1, in dB; IDENTICAL at most."""
    error = float(np.square(a - b).mean())
    return min(-10 / _LN_10 * float(log(error)), IDENTICAL) if error > 0 else IDENTICAL


def ssim(a: Floats, b: Floats) -> float:
    """Structural similarity of (H, W, 3) in 0..1: the mean over channels and over all places where an 11 x 11 Gaussian
    window (sigma 1.5) fits; 1 for equal pictures. Source: Wang et al., 2004. Pictures smaller than the window get one
    as large as they are.
    """
    size = min(_WINDOW, *a.shape[:2])
    x = np.arange(size) - (size - 1) / 2
    window = exp(-0.5 * (x / _SIGMA) ** 2)
    window /= window.sum()

    def blur(values: Floats) -> Floats:
        for axis in (0, 1):
            moved = np.moveaxis(values, axis, 0)
            count = len(moved) - size + 1
            total = window[0] * moved[:count]
            for k in range(1, size):
                total += window[k] * moved[k : k + count]
            values = np.moveaxis(total, 0, axis)
        return values

    mean_a, mean_b = blur(a), blur(b)
    var_a, var_b = blur(a * a) - mean_a**2, blur(b * b) - mean_b**2
    both = blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    structure = (2 * both + _C2) / (var_a + var_b + _C2)
    return float((luminance * structure).mean())
