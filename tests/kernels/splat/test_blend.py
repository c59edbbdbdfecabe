"""The exponential of the blending."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.splat.blend import short_exp


def test_the_exponential_is_exact_to_three_millionths() -> None:
    x = -np.linspace(0, 6, 3001).astype(np.float32)
    made = np.array([short_exp(each) for each in x], np.float64)
    assert np.abs(made / np.exp(x.astype(np.float64)) - 1).max() < 3e-6
    assert short_exp(np.float32(-1e30)) == short_exp(np.float32(-6))
