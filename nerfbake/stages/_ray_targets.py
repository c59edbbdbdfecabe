"""The pixels of one posed picture that a fit uses, with their target colours and rays."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Floats, Ints, Singles
from nerfbake.kernels.dilation import dilated
from nerfbake.kernels.fit import colours as kernels
from nerfbake.scene.camera import Camera
from nerfbake.scene.views import Views
from nerfbake.stages._depth_map import DepthMap, surface_distances

_SHARE = 8  # targets are kept in one part of so many of the memory that is left


class RayTargets(NamedTuple):
    """The rays of some pixels, and the colours that they should have.

    eye         (3,) in the world
    pixels      (m,) indices into the picture, tile by tile of 8 x 8 pixels, so that neighbours are close together
    targets     (m, 4) colour over the background, and alpha
    distances   (m,) of the surface that each pixel shows, see FitView; or (0,)
    directions  (m samples^2, 3), pixel by pixel
    """

    eye: Floats
    pixels: npt.NDArray[np.int32]
    targets: Singles
    distances: Singles
    directions: Singles


def ray_targets(views: Views, view: int, *, scale: int, samples: int, ring: int | None) -> RayTargets:
    """Return the pixels of a view that are not only background, and all pixels up to `ring` pixels from them.

    The picture is first reduced by the factor `scale`. ring None returns all pixels. Pixels that views.used() excludes
    are left out. samples: rays along each edge of a pixel.
    """
    return _with_rays(used_pixels(views, view, scale, ring), samples)


class KeptTargets:
    """The rays and targets of views, as ray_targets() returns them: read-only, and computed once while memory allows.

    `size`: the number of bytes that are kept, for one scale at a time.
    """

    def __init__(self, views: Views, *, ring: int | None, depths: Mapping[int, DepthMap]) -> None:
        self._views, self._depths, self._ring, self._scale = views, depths, ring, 0
        self._kept: dict[int, UsedPixels] = {}
        self._room, self.size = memory.left() // _SHARE, 0

    def of(self, view: int, *, scale: int, samples: int, keep: bool, tilt: float = 0.0) -> RayTargets:
        """Return the targets of a view. keep: until they are asked for again. tilt: as in pinhole_directions()."""
        if scale != self._scale:
            self._kept, self.size, self._scale = {}, 0, scale
        pixels = self._kept.pop(view, None)
        if pixels is None:
            pixels = used_pixels(self._views, view, scale, self._ring, self._depths.get(view))
        else:
            self.size -= pixels.size
        if keep and self.size + pixels.size <= self._room:
            self._kept[view] = pixels
            self.size += pixels.size
        return _with_rays(pixels, samples, tilt)

    def give_up(self) -> None:
        """Keep nothing from now on."""
        self._kept, self.size, self._room = {}, 0, 0


class UsedPixels(NamedTuple):
    """The pixels of a view that a fit uses. numbers, targets, distances: as `pixels` and so on of RayTargets."""

    camera: Camera
    numbers: npt.NDArray[np.int32]
    targets: Singles
    distances: Singles

    @property
    def size(self) -> int:
        """Number of bytes."""
        return self.numbers.nbytes + self.targets.nbytes + self.distances.nbytes


def used_pixels(views: Views, view: int, scale: int, ring: int | None, depths: DepthMap | None = None) -> UsedPixels:
    """Return the pixels of ray_targets(), and the camera of the reduced view. depths: that the view shows."""
    camera, image = reduced_view(views, view, scale)
    if ring is not None:
        held = image[None, ..., 3] > 0
        for _ in range(ring):
            held = dilated(held)
        chosen = held[0]
    elif views.scenery and views.masked:
        chosen = image[..., 3] >= 1
    else:
        chosen = np.ones(image.shape[:2], bool)
    pixels = np.empty(chosen.size, np.int32)
    found = kernels.number_pixels(np.ascontiguousarray(chosen), _tiles(camera.width, camera.height), pixels)
    pixels = pixels[:found].copy()
    distances = np.zeros(0, np.float32) if depths is None else surface_distances(depths, camera).reshape(-1)[pixels]
    return UsedPixels(camera, pixels, image.reshape(-1, 4)[pixels], distances)


def _with_rays(pixels: UsedPixels, samples: int, tilt: float = 0.0) -> RayTargets:
    directions = _directions(pixels.camera, pixels.numbers, samples, tilt)
    eye = pixels.camera.pose[:3, 3].copy()
    return RayTargets(eye, pixels.numbers, pixels.targets, pixels.distances, directions)


def reduced_view(views: Views, view: int, scale: int) -> tuple[Camera, Singles]:
    """Return a view reduced by the factor `scale`: its camera, and (H, W, 4) colour over the background, and alpha."""
    camera = views.cameras.cameras[view].reduced(scale)
    image = np.empty((camera.height, camera.width, 4), np.float32)
    kernels.downscale(views.pictures[view], np.array(views.background, np.float64), views.masked, scale, image)
    return camera, image


def _directions(camera: Camera, pixels: npt.NDArray[np.int32], samples: int, tilt: float) -> Singles:
    if camera.bends:  # without the tilt: each one would need directions of the whole picture through the lens
        fine = camera.part(slice(0, camera.width), slice(0, camera.height), finer=samples)
        rays = fine.rays()[1].reshape(camera.height, samples, camera.width, samples, 3).transpose(0, 2, 1, 3, 4)
        return rays.reshape(-1, samples * samples * 3)[pixels].reshape(-1, 3).astype(np.float32)
    out = np.empty((len(pixels) * samples * samples, 3), np.float32)
    optics, turn = np.array([camera.fx, camera.fy, camera.cx, camera.cy]), np.ascontiguousarray(camera.pose[:3, :3])
    kernels.pinhole_directions(pixels, camera.width, optics, turn, samples, tilt, out)
    return out


@lru_cache(maxsize=8)
def _tiles(width: int, height: int) -> Ints:
    return kernels.tile_order(width, height)
