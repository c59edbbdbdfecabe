"""Directions spread evenly over the unit sphere."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.maths.elementary import sine_cosine


def fibonacci(N: int) -> npt.NDArray[np.float64]:
    """(N, 3) unit directions on a golden-angle spiral about z. Source: docs/conventions.md, "Direction sets"."""
    i = np.arange(N) + 0.5
    z, turn = 1 - 2 * i / N, np.pi * (1 + np.sqrt(5)) * i
    (sine, cosine), wide = sine_cosine(turn), np.sqrt(1 - z * z)
    return np.stack([cosine * wide, sine * wide, z], axis=1)
