"""Which pixels of photographs show the sky, which is behind everything else.

docs/tuning.md, "Sky", has the measurements.
"""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.scene.camera import Camera, Cameras

_UPRIGHT = 0.5  # least length of the mean of the cameras' upward axes, if photographs are mostly held upright
_OUTWARD = 0.5  # least cosine of the angle between the way out of a picture across an edge and the vertical
_SMOOTH = 0.02  # most difference of neighbouring pixels of the sky in each channel
_HIGH = 0.9  # share of a part that is above the horizon: plain walls and ground go on below it
_WARM, _DARK = 0.02, 0.25  # mean red of the sky above its mean blue, at most; least mean blue
_LEAST = 0.04  # share of a picture of a part of the sky
_WITHIN, _KNOWN = 4, 0.1  # of the pixels so far within the sky, the share that may look like a place in other pictures


def upward(cameras: Cameras) -> Floats | None:
    """Return the unit vector (3,) that points up if the photographs are held upright, or None if they are not."""
    up = np.stack([camera.pose[:3, 1] for camera in cameras.cameras]).mean(axis=0)
    length = float(np.sqrt(np.square(up).sum()))
    return up / length if length >= _UPRIGHT else None


def find_sky(camera: Camera, image: Singles, up: Floats) -> Bits:
    """Return the pixels (H, W) of a picture that may show the sky.

    They are smooth up to the upper edge, not warm, and end at the horizon or above it. image (H, W, 4): colour and
    alpha.
    """
    height, width = image.shape[:2]
    looks = camera.rays()[1].reshape(height, width, 3)
    used, high = image[..., 3] >= 1, (looks * up).sum(axis=-1) > 0
    across, down = (
        (np.abs(np.diff(image[..., :3], axis=axis)).max(axis=-1) <= _SMOOTH)
        & np.delete(used, 0, axis)
        & np.delete(used, -1, axis)
        for axis in (1, 0)
    )
    seeds, ways = np.zeros((height, width), bool), (camera.pose[:3, :2] * up[:, None]).sum(axis=0)
    for edge, way in ((np.s_[0], ways[1]), (np.s_[-1], -ways[1]), (np.s_[:, -1], ways[0]), (np.s_[:, 0], -ways[0])):
        if way > _OUTWARD:
            seeds[edge] = used[edge] & high[edge]
    sky = np.zeros((height, width), bool)
    while seeds.any():
        part = _reached(int(seeds.argmax()), across, down)
        seeds &= ~part
        red, blue = (float(image[..., channel][part].mean()) for channel in (0, 2))
        own = part & high
        large = own.sum() >= max(_LEAST * part.size, _HIGH * part.sum())
        if large and red <= blue + _WARM and blue >= _DARK:
            sky |= own
    return sky


def _reached(start: int, across: Bits, down: Bits) -> Bits:
    """Return the pixels (H, W) to which ways lead from one of them, a place in the flat picture.

    across (H, W - 1), down (H - 1, W): whether a way leads from a pixel to its right neighbour, and to its lower one.
    """
    part = np.zeros((len(across), down.shape[1]), bool)
    part.flat[start] = True
    found = 0
    while (count := int(part.sum())) > found:
        found = count
        part[1:] |= part[:-1] & down
        part[:-1] |= part[1:] & down
        part[:, 1:] |= part[:, :-1] & across
        part[:, :-1] |= part[:, 1:] & across
    return part


def distance_within(sky: Bits, known: Bits) -> Singles:
    """Return for each pixel (H, W) how many pixels it is away from those that are not sky, at least.

    known (H, W): pixels whose depth other pictures confirm. If there are many of them within the sky, it is no sky.
    """
    distance = np.where(sky, np.inf, 0)
    for axis, length in enumerate(sky.shape):
        place = np.expand_dims(np.arange(length), 1 - axis)
        before = np.minimum.accumulate(distance - place, axis=axis) + place
        after = np.flip(np.minimum.accumulate(np.flip(distance + place, axis), axis=axis), axis) - place
        distance = np.minimum(before, after)
    distance *= np.sqrt(0.5)  # the sum along both axes is at most so much longer than the straight way
    within = distance > _WITHIN
    if known[within].sum() > _KNOWN * within.sum():
        return np.zeros(sky.shape, np.float32)
    return distance.astype(np.float32)
