"""What sparse points tell a fit of scenery before it starts: between which distances a picture shows something.

docs/tuning.md, "Free space", has the measurements.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import Cameras

LEAST_POINTS = 30  # of a picture: fewer tell nothing
_SOUND = 0.02, 0.98  # quantiles of the distances of a picture's points: others may be wrong
_BEFORE, _BEHIND = 0.8, 1.25  # of the distances of points: nearer places are empty, and farther ones are hidden
_EVEN = 2.0  # largest ratio of the distances of the points of a picture that looks equally far everywhere


class Reach(NamedTuple):
    """near, far (cameras,): the distances between which each picture shows something; 0 and infinity if unknown."""

    near: Floats
    far: Floats


def reach_of(cameras: Cameras) -> Reach:
    """Return the reach of each picture. It is known for those whose points are about equally far, as from a drone."""
    points, count = cameras.points, len(cameras.cameras)
    found = Reach(np.zeros(count), np.full(count, np.inf))
    if points is None:
        return found
    for number, camera in enumerate(cameras.cameras):
        seen = points.positions[points.point[points.camera == number]]
        if len(seen) < LEAST_POINTS:
            continue
        away = np.sort(np.sqrt(np.square(seen - camera.pose[:3, 3]).sum(axis=1)))
        low, high = (float(away[round(share * (len(away) - 1))]) for share in _SOUND)
        if high <= _EVEN * low:
            found.near[number], found.far[number] = _BEFORE * low, _BEHIND * high
    return found
