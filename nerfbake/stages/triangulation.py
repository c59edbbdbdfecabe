"""Pixels of photographs that show the same point -> the point.

Source: Hartley and Sturm, "Triangulation" (1997), of which this is the linear method, with the weights of its pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import inverse, length, rotate
from nerfbake.kernels.maths.elementary import arctan
from nerfbake.scene.camera import Camera

_ANGLE = 1.5  # degrees between rays, as COLMAP's filter_min_tri_angle: 1/50 degree then moves the point by 1.3 %
_MISS = 0.005  # of the picture's longer edge: more is another point, or a wrong pose
_LEAST_MISS = 2.0  # pixels, for small pictures
_ROUNDS = 3  # of weights: the distance from each camera changes the point by less than a pixel


class Sighting(NamedTuple):
    """A camera that sees a point at x, y, in pixels from the upper left corner of its picture."""

    camera: Camera
    x: float
    y: float


class Triangulated(NamedTuple):
    """position (3,). miss: the largest distance of a sighting from where its camera sees it, in pixels.

    angle: the largest one between two rays, in degrees.
    """

    position: Floats
    miss: float
    angle: float


def triangulate(sightings: Sequence[Sighting]) -> Triangulated:
    """Return the point that two or more cameras see.

    It is the nearest one to all rays, each in pixels of its picture. Raises InvalidScene for rays that are nearly
    parallel, that pass each other by more than 0.5 % of the picture's longer edge, or that meet behind a camera.

    >>> import numpy as np
    >>> from nerfbake import Camera
    >>> left, right = Camera(80, 60, 100.0, np.eye(4)), Camera(80, 60, 100.0, np.eye(4))
    >>> right.pose[0, 3] = 1.0
    >>> triangulate([Sighting(left, 50, 30), Sighting(right, 30, 30)]).position
    array([ 0.5,  0. , -5. ])
    """
    names = "+".join(f"{each.camera.name}:{each.x:g}:{each.y:g}" for each in sightings)
    looks = np.stack([each.camera.look(each.x, each.y) for each in sightings])
    eyes = np.stack([each.camera.pose[:3, 3] for each in sightings])
    angle = _widest(looks)
    if angle < _ANGLE:
        found = f"are seen along rays that are {angle:.2g} degrees apart"
        raise InvalidScene(Problem(names, found, f"{_ANGLE:g} or more: photographs taken further apart"))
    across = np.eye(3) - looks[:, :, None] * looks[:, None]
    weights, position = np.ones(len(looks)), eyes.mean(axis=0)
    for _ in range(_ROUNDS):
        left = (weights[:, None, None] * across).sum(axis=0)
        right = (weights[:, None, None] * across * eyes[:, None]).sum(axis=(0, 2))
        position = rotate(right, inverse(left))
        weights = 1 / np.maximum(np.square(position - eyes).sum(axis=1), 1e-300)
    misses = [_miss(each, look, position) for each, look in zip(sightings, looks, strict=True)]
    for each, miss in zip(sightings, misses, strict=True):
        if miss is None:
            found = f"meet behind {each.camera.name}"
            raise InvalidScene(Problem(names, found, "pixels that show the same point"))
        allowed = max(_MISS * max(each.camera.width, each.camera.height), _LEAST_MISS)
        if miss > allowed:
            found = f"are not the same point: their rays miss each other by {miss:.3g} pixels in {each.camera.name}"
            raise InvalidScene(Problem(names, found, f"up to {allowed:.3g}"))
    return Triangulated(position, max(miss for miss in misses if miss is not None), angle)


def _widest(looks: Floats) -> float:
    """The largest angle between two of these unit vectors (n, 3), in degrees."""
    apart, along = (np.sqrt(np.square(looks[:, None] + sign * looks).sum(axis=2)) for sign in (-1, 1))
    return float(np.degrees(2 * arctan(apart / np.maximum(along, 1e-12))).max())


def _miss(sighting: Sighting, look: Floats, position: Floats) -> float | None:
    """The distance of a sighting from where its camera sees a position, in pixels; None if that is behind the camera.

    The picture around the sighting counts as flat, which is exact for a miss of 0.
    """
    camera, x, y = sighting
    towards = position - camera.pose[:3, 3]
    ahead = float((towards * look).sum())
    if not ahead > 0:
        return None
    inwards = (1.0 if x < camera.width / 2 else -1.0), (1.0 if y < camera.height / 2 else -1.0)
    right = (camera.look(x + inwards[0], y) - look) * inwards[0]
    down = (camera.look(x, y + inwards[1]) - look) * inwards[1]
    off = towards / ahead - look
    aa, ab, bb = (float((first * second).sum()) for first, second in ((right, right), (right, down), (down, down)))
    a, b = (float((off * axis).sum()) for axis in (right, down))
    across = np.array([bb * a - ab * b, aa * b - ab * a]) / (aa * bb - ab * ab)
    return length(across)
