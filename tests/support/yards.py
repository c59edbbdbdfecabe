"""Photographs of a keep and its walls under a smooth sky, with exact cameras and exact masks of the sky."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import Camera, Cameras, Views
from nerfbake.kernels.arrays import Bits, Floats
from nerfbake.scene.camera import look_at
from nerfbake.stages.shapes_to_image import _noise, _through

FOCUS = np.array([0.0, 0.0, 3.5])
SUN = np.array([0.6, 0.64, 0.48])
# Opposite corners of boxes in metres: a keep, its two towers, a wall to each side, a shed, and a hill far behind.
BOXES = np.array(
    [
        [[-3, -3, 0], [3, 3, 6]],
        [[-4, -4, 0], [-2, -2, 9]],
        [[2.2, -1, 0], [4.2, 1, 7.5]],
        [[-12, -1, 0], [-3, 0, 3]],
        [[4, 1, 0], [13, 2, 3.4]],
        [[1, -7, 0], [3.4, -5.5, 2.2]],
        [[-60, 70, 0], [30, 90, 9]],
    ],
    np.float64,
)


class Yard(NamedTuple):
    """views, and for each of them the pixels (H, W) that show the sky."""

    views: Views
    sky: list[Bits]


def yard(*, frames: int = 14, width: int = 240, height: int = 160, samples: int = 2, seed: int = 0) -> Yard:
    """Cameras on an arc of 150 degrees around the keep, in two heights."""
    cameras, pictures, skies = [], [], []
    for number in range(frames):
        turn = np.radians(-165 + 150 * number / max(frames - 1, 1))
        pose = look_at(FOCUS, turn, np.radians((-7.0, 1.0)[number % 2]), 15.0 + 2 * (number % 3))
        pose[2, 3] = max(pose[2, 3], 1.4)
        camera = Camera(width, height, 0.85 * width, pose, f"{number:04d}")
        colour, sky = _pixels(camera, samples, seed)
        cameras.append(camera)
        pictures.append(np.concatenate([colour, np.full_like(colour[..., :1], 255)], axis=2))
        skies.append(sky)
    return Yard(Views(Cameras(tuple(cameras)), tuple(pictures), (0.5, 0.5, 0.5), False, scenery=True), skies)


def _pixels(camera: Camera, samples: int, seed: int) -> tuple[npt.NDArray[np.uint8], Bits]:
    """Return the colours, and the pixels of which all rays end in the sky."""
    fine = camera.part(slice(0, camera.width), slice(0, camera.height), finer=samples)
    eye, looks = fine.rays()
    d = np.ascontiguousarray(looks.T)
    reciprocal = 1 / np.where(d == 0, 1e-300, d)
    distance, surface = np.full(d.shape[1], np.inf), np.full(d.shape[1], -1)
    normal = np.zeros(d.shape)
    down = d[2] < -1e-6
    distance[down], surface[down] = -eye[2] / d[2, down], 0
    normal[2] = 1
    for number, box in enumerate(BOXES, start=1):
        enter, leave = _through(box, eye, reciprocal)
        near = enter.max(axis=0)
        met = np.flatnonzero((near > 0) & (near < leave.min(axis=0)) & (near < distance))
        axis = enter[:, met].argmax(axis=0)
        distance[met], surface[met], normal[:, met] = near[met], number, 0
        normal[axis, met] = -np.sign(d[axis, met])
    random = np.random.default_rng(seed)
    paint, layer = (
        random.uniform(0.35, 0.75, (len(BOXES) + 1, 3)),
        random.integers(0, 1 << 32, len(BOXES) + 1, np.uint32),
    )
    sky = surface < 0
    colour = _sky(d)
    some = np.flatnonzero(~sky)
    size = np.where(surface[some] == len(BOXES), 30.0, 4.0)
    share = _noise((eye[:, None] + distance[some] * d[:, some]) / size, layer[surface[some]])
    lit = 0.7 + 0.3 * (normal[:, some] * SUN[:, None]).sum(axis=0)
    colour[:, some] = paint[surface[some]].T * lit * (0.4 + 0.9 * share)
    haze = np.exp(-distance[some] / 120)
    colour[:, some] = colour[:, some] * haze + (1 - haze) * np.array([0.75, 0.8, 0.85])[:, None]
    shape = camera.height, samples, camera.width, samples
    mean = np.clip(colour.reshape(3, *shape).mean(axis=(2, 4)), 0, 1).transpose(1, 2, 0)
    return np.rint(255 * mean).astype(np.uint8), np.asarray(sky.reshape(shape).all(axis=(1, 3)))


def _sky(d: Floats) -> Floats:
    """Blue above, nearly white at the horizon, and brighter around the sun."""
    up = np.sqrt(np.clip(d[2], 0, 1))
    colour = np.array([0.78, 0.84, 0.9])[:, None] * (1 - up) + np.array([0.25, 0.45, 0.8])[:, None] * up
    glow = np.clip((d * SUN[:, None]).sum(axis=0), 0, 1) ** 6
    return np.asarray(colour + 0.2 * glow)
