"""Directions spread evenly over the unit sphere."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def fibonacci(N: int) -> npt.NDArray[np.float64]:
    """(N, 3) unit directions on a golden-angle spiral about z. Source: spec/atlas.md, 2."""
    i = np.arange(N) + 0.5
    polar, turn = np.arccos(1 - 2 * i / N), np.pi * (1 + np.sqrt(5)) * i
    return np.stack([np.cos(turn) * np.sin(polar), np.sin(turn) * np.sin(polar), np.cos(polar)], axis=1)
