"""What a picture and its neighbours show about depths."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.scene.camera import Camera


class DepthMap(NamedTuple):
    """What a picture and its neighbours show.

    camera   a pinhole
    inverse  (H, W) inverse depths along the optical axis, of all pixels
    known    (H, W) bool: the neighbours have the same depth here; other depths are the farthest ones around
    step     between two planes
    sky      (H, W) pixels to the nearest pixel that does not show the sky, or less; 0: the pixel does not
    """

    camera: Camera
    inverse: Floats
    known: Bits
    step: float
    sky: Singles


def surface_distances(found: DepthMap, camera: Camera) -> Singles:
    """Return (H, W): the distance from the eye to the surface that each pixel of a camera shows, 0 if it is not known.

    camera: that of the picture, with any number of pixels, and with its lens.
    """
    distances, plane = np.zeros((camera.height, camera.width), np.float32), camera.plane()
    if plane is None:  # wider than half of all directions
        return distances
    seen = found.camera
    column, row = np.floor(seen.fx * plane[..., 0] + seen.cx), np.floor(seen.fy * plane[..., 1] + seen.cy)
    inside = (column >= 0) & (row >= 0) & (column < seen.width) & (row < seen.height)
    at = tuple(np.where(inside, place, 0).astype(np.int64) for place in (row, column))
    inverse, slant = found.inverse[at], np.sqrt(1 + np.square(plane).sum(axis=2))
    np.divide(slant, inverse, out=distances, where=inside & found.known[at] & (inverse > 0), casting="same_kind")
    return distances
