"""What there is to know about pictures."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.scene.depth import Depth
from nerfbake.scene.image import Image


def summary_of_picture(picture: Image | Depth) -> dict[str, Any]:
    """Size in pixels; of a picture how much of it is opaque, of depth what is met and how far away."""
    if isinstance(picture, Image):
        H, W = picture.alpha.shape
        return {
            "kind": "picture",
            "size": [W, H],
            "opaque": float((picture.alpha == 1).mean()),
            "transparent": float((picture.alpha == 0).mean()),
            "mean_colour": picture.colour.mean(axis=(0, 1), dtype=np.float64).tolist(),
        }
    H, W = picture.distance.shape
    met = picture.distance[picture.distance > 0]
    return {
        "kind": "depth",
        "size": [W, H],
        "met": len(met) / picture.distance.size,
        "range": [float(met.min()), float(met.max())] if len(met) else None,
    }
