"""What a fit takes from posed pictures: some pixels of one view, their colours and their rays."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.fit import pixels as kernels
from nerfbake.scene.camera import Camera
from nerfbake.scene.views import Views


class Looks(NamedTuple):
    """eye (3,) in the world; pixels (m,) their numbers, row by row, in the picture; targets (m, 4): colour over the
    background, and alpha; directions (m samples^2, 3), the rays of a pixel together.
    """

    eye: Floats
    pixels: npt.NDArray[np.int32]
    targets: Singles
    directions: Singles


def looks_of(views: Views, view: int, *, scale: int, samples: int, ring: int | None) -> Looks:
    """Of a view whose picture is `scale` times smaller, the pixels that are not all background, and `ring` more around
    them; None: all pixels. samples: rays an edge of a pixel.
    """
    picture, camera = views.pictures[view], zoomed(views.cameras.cameras[view], scale)
    image = np.empty((camera.height, camera.width, 4), np.float32)
    kernels.shrunk(picture, np.array(views.background, np.float64), views.masked, scale, image)
    pixels = np.arange(camera.width * camera.height, dtype=np.int32)
    if ring is not None:
        held = image[None, ..., 3] > 0
        for _ in range(ring):
            held = dilated(held)
        found = kernels.chosen(np.ascontiguousarray(held[0]), _tiles(camera.width, camera.height), pixels)
        pixels = pixels[:found].copy()
    return Looks(
        camera.pose[:3, 3].copy(), pixels, kernels.gathered(image, pixels), _directions(camera, pixels, samples)
    )


def zoomed(camera: Camera, scale: int) -> Camera:
    """The camera of a picture whose pixels are the means of scale^2 pixels; those left over at its ends are cut off."""
    if scale == 1:
        return camera
    centre = camera.cx / scale, camera.cy / scale
    edges = max(camera.width // scale, 1), max(camera.height // scale, 1)
    return replace(camera, width=edges[0], height=edges[1], focal=(camera.fx / scale, camera.fy / scale), centre=centre)


def _directions(camera: Camera, pixels: npt.NDArray[np.int32], samples: int) -> Singles:
    if camera.lens is not None and camera.lens.bends:
        fine = camera.part(slice(0, camera.width), slice(0, camera.height), finer=samples)
        rays = fine.rays()[1].reshape(camera.height, samples, camera.width, samples, 3).transpose(0, 2, 1, 3, 4)
        return rays.reshape(-1, samples * samples * 3)[pixels].reshape(-1, 3).astype(np.float32)
    out = np.empty((len(pixels) * samples * samples, 3), np.float32)
    optics, turn = np.array([camera.fx, camera.fy, camera.cx, camera.cy]), np.ascontiguousarray(camera.pose[:3, :3])
    kernels.pinhole_looks(pixels, camera.width, optics, turn, samples, out)
    return out


@lru_cache(maxsize=8)
def _tiles(width: int, height: int) -> Ints:
    return kernels.tile_order(width, height)
