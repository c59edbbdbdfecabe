"""Texture lookups.

Texel (i, j) is the value at its centre, ((i + 1/2) / W, (j + 1/2) / H), v down. Textures repeat along both axes.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints


def blend(fetch: Callable[[Ints, Ints], npt.NDArray[Any]], place: npt.NDArray[np.float64]) -> npt.NDArray[np.float32]:
    """Interpolate between the four texels around a position (..., 2), x and y in texel centres.

    fetch(y, x) returns texels (..., C).
    """
    low = np.floor(place).astype(np.int64)
    fraction = (place - low).astype(np.float32)
    x, y, fx, fy = low[..., 0], low[..., 1], fraction[..., :1], fraction[..., 1:]
    top = fetch(y, x) * (1 - fx) + fetch(y, x + 1) * fx
    bottom = fetch(y + 1, x) * (1 - fx) + fetch(y + 1, x + 1) * fx
    return np.asarray(top * (1 - fy) + bottom * fy, np.float32)


def bilinear(texture: npt.NDArray[np.uint8], uvs: npt.NDArray[Any]) -> npt.NDArray[np.float32]:
    """(m, C) in 0..1: a texture (H, W, C) at (m, 2) coordinates, interpolated between texel centres."""
    H, W = texture.shape[:2]
    uvs = uvs - np.floor(uvs)  # before they are scaled to large numbers of texels
    return blend(lambda y, x: texture[y % H, x % W], uvs * (W, H) - 0.5) / np.float32(255)


def nearest_texel(texture: npt.NDArray[Any], uvs: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """(m, ...): the texel of (H, W, ...) that contains each of (m, 2) coordinates."""
    H, W = texture.shape[:2]
    x, y = ((uvs - np.floor(uvs)) * (W, H)).astype(np.int64).T
    return np.asarray(texture[y % H, x % W])
