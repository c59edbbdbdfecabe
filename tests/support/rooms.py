"""Small photographs of a textured corner of a room, whose poses can be found."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image as Pillow

from nerfbake.scene.camera import look_at

Array = npt.NDArray[np.float64]
WIDTH, HEIGHT, FOCAL = 240, 180, 220.0
_TEXELS = 512


def write_room(folder: Path, *, frames: int = 8, first: int = 0) -> Array:
    """Write NNNN.png to the folder, and return the positions of the cameras, (frames, 3).

    first: the number of the first picture; rooms with different numbers have different textures.
    """
    folder.mkdir(parents=True, exist_ok=True)
    textures = [_texture(first + axis) for axis in range(3)]
    poses = [_pose(i / (frames - 1)) for i in range(frames)]
    for i, pose in enumerate(poses):
        Pillow.fromarray(_picture(pose, textures)).save(folder / f"{first + i:04d}.png")
    return np.array([pose[:3, 3] for pose in poses])


def _pose(share: float) -> Array:
    """A camera on an arc around the corner at the origin, whose height varies."""
    return look_at(np.full(3, 0.3), np.radians(20 + 50 * share), 0.5 + 0.2 * np.sin(5 * share), 2.2)


def _texture(number: int) -> Array:
    """Random blobs of several sizes, (_TEXELS, _TEXELS) in 0..1."""
    random = np.random.default_rng(number)
    total = np.zeros((_TEXELS, _TEXELS))
    for cells in (32, 64, 128):
        total += np.kron(random.uniform(0, 1, (cells, cells)), np.ones((_TEXELS // cells,) * 2))
    return total / 3


def _picture(pose: Array, textures: list[Array]) -> npt.NDArray[np.uint8]:
    """(HEIGHT, WIDTH, 3): the planes x = 0, y = 0 and z = 0 with 2 x 2 rays per pixel, each 4 units wide."""
    y, x = np.mgrid[: 2 * HEIGHT, : 2 * WIDTH]
    plane = np.stack([((x + 0.5) / 2 - WIDTH / 2) / FOCAL, (HEIGHT / 2 - (y + 0.5) / 2) / FOCAL, -np.ones(x.shape)], -1)
    rays = plane @ pose[:3, :3].T
    nearest, shade = np.full(x.shape, np.inf), np.zeros(x.shape)
    for axis, texture in enumerate(textures):
        distance = -pose[axis, 3] / np.where(rays[..., axis] < 0, rays[..., axis], -1e-9)
        point = np.delete(pose[:3, 3] + distance[..., None] * rays, axis, axis=-1)
        row, column = np.clip(point / 4 * _TEXELS, 0, _TEXELS - 1).astype(int).transpose(2, 0, 1)
        shade = np.where(distance < nearest, texture[row, column], shade)
        nearest = np.minimum(nearest, distance)
    grey = shade.reshape(HEIGHT, 2, WIDTH, 2).mean(axis=(1, 3))
    pixels: npt.NDArray[np.uint8] = np.rint(np.repeat(grey[..., None], 3, axis=2) * 255).astype(np.uint8)
    return pixels
