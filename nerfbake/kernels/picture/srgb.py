"""sRGB's curve: what a screen is given against what light adds up. Source: IEC 61966-2-1."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.maths.elementary import power


def from_linear(light: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """Linear 0..1 -> sRGB 0..1; what is outside is cut."""
    light = np.clip(light, 0, 1)
    curve = np.where(light <= 0.0031308, 12.92 * light, 1.055 * power(np.maximum(light, 0.0031308), 1 / 2.4) - 0.055)
    return np.clip(curve, 0, 1).astype(np.float32)


def to_linear(colour: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """sRGB 0..1 -> linear 0..1."""
    return np.where(
        colour <= 0.04045, colour / 12.92, power((np.asarray(colour, np.float64) + 0.055) / 1.055, 2.4)
    ).astype(np.float32)
