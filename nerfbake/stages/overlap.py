"""Which photographs show the same, by where their cameras stand and look.

docs/tuning.md, "Photographs that are alone", has the measurements.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.maths.affine import rotate
from nerfbake.scene.camera import Camera

_OTHERS = 4  # pictures that a picture is compared with
_SINE = 0.14  # of the angle between two views of a place that shows its depth best
_SAME_SIDE = 0.7  # least cosine of the angle between two views of a place that look alike
_SHARED = 0.05  # least worth of a neighbour, see neighbours()
_SAMPLES = 7  # places along an edge of a picture that tell which neighbours show them


class Overlap(NamedTuple):
    """How much pictures show together.

    share      0..1: of the places that a picture shows, the share that at least two others show from about the same
               side, as far as their cameras tell; a mean over all pictures
    agreement  0..1: of the pixels that look like a place in a neighbouring picture, the share whose depth other
               pictures confirm; None: too few pictures or pixels to say. It is low if poses are wrong.
    alone      numbers of the pictures of which hardly any other one shows anything, or confirms any depth
    """

    share: float
    agreement: float | None
    alone: tuple[int, ...]


def neighbours(cameras: tuple[Camera, ...], number: int, distance: float) -> tuple[list[int], float]:
    """Return the cameras that show most of what a camera shows at a distance, at a good angle, the best one first.

    And the share of it that at least two others show from about the same side, 0 to 1.
    """
    own, steps = cameras[number], (np.arange(_SAMPLES) + 0.5) / _SAMPLES
    x, y = np.meshgrid((steps * own.width - own.cx) / own.fx, (steps * own.height - own.cy) / own.fy)
    looks = np.stack([x.ravel(), -y.ravel(), np.full(x.size, -1.0)], axis=1)
    places = rotate(distance * looks, own.pose[:3, :3])
    poses = np.stack([camera.pose for camera in cameras])
    away = (own.pose[:3, 3] + places)[:, None] - poses[:, :3, 3]  # (places, cameras, 3)
    across, up, back = (
        sum(away[..., axis] * poses[:, axis, column] for axis in range(3)) for column in range(3)
    )  # each (places, cameras)
    optics = np.array([(each.fx, each.fy, each.cx, each.cy, each.width, each.height) for each in cameras])
    fx, fy, cx, cy, wide, high = optics.T
    ahead = np.maximum(-back, 1e-9)
    column, row = fx * across / ahead + cx, cy - fy * up / ahead
    inside = (back < 0) & (column >= 0) & (column < wide) & (row >= 0) & (row < high)
    turned = np.square(np.cross(places[:, None], away)).sum(axis=-1)
    lengths = np.square(places).sum(axis=-1)[:, None] * np.square(away).sum(axis=-1)
    sine = np.sqrt(turned / np.maximum(lengths, 1e-30))
    worth = (inside * np.minimum(sine / _SINE, _SINE / np.maximum(sine, 1e-9))).sum(axis=0) / len(places)
    worth[number] = 0
    order = np.argsort(-worth, kind="stable")[:_OTHERS]
    found = inside & ((places[:, None] * away).sum(axis=-1) > _SAME_SIDE * np.sqrt(lengths))
    found[:, number] = False
    share = float((found.sum(axis=1) >= 2).mean())
    return [int(other) for other in order if worth[other] >= _SHARED], share
