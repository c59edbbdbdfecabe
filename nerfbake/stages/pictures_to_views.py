"""Cameras and their pictures -> views: each camera in its picture's size, and what stands behind the object."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.image import WHITE
from nerfbake.scene.views import Views, near_colour

PLAIN_SHARE = 0.7  # of the pixels at the pictures' edges: where the object is cut off, some of them show it

Pixels = npt.NDArray[np.uint8]
Colour = tuple[float, float, float]


def build_views(cameras: Cameras, pictures: Iterable[Pixels], *, background: Colour | None = None) -> Views:
    """Each camera with its picture, (H, W, 4) uint8 of straight sRGB colour and alpha.

    A camera of another size than its picture, but of its shape, is resized. background: the sRGB colour in 0..1 that
    stands behind the object; None: white where any of the pictures has alpha, else the median of the pixels at their
    edges. Of pictures without alpha, seven in ten of those pixels must have that colour (+-16 of 255), since what is
    behind the object could not be told from it otherwise.

    Raises InvalidScene for a picture of another shape than its camera's, for scenery behind the object, and for
    pictures that show nothing but background.

    >>> import numpy as np
    >>> from nerfbake import Camera, Cameras, build_views
    >>> cameras = Cameras((Camera(800, 600, 1000.0, np.eye(4), "front"),))
    >>> picture = np.full((3, 4, 4), 255, np.uint8)
    >>> picture[1, 1, :3] = 0
    >>> views = build_views(cameras, [picture])
    >>> views.cameras.cameras[0].fx, views.background, views.masked
    (5.0, (1.0, 1.0, 1.0), False)
    """
    kept, fitting = [], []
    for camera, pixels in zip(cameras.cameras, pictures, strict=False):
        fitting.append(_resized(camera, pixels))
        kept.append(pixels)
    if len(kept) != len(cameras.cameras):
        raise InvalidScene(Problem("pictures", f"are {len(kept):,}", f"{len(cameras.cameras):,}, one a camera"))
    masked = any(int(pixels[..., 3].min()) < 255 for pixels in kept)
    behind = (background or WHITE) if masked else _plain_background(kept, background)
    views = Views(replace(cameras, cameras=tuple(fitting)), tuple(kept), behind, masked)
    if all(views.behind(i).all() for i in range(len(kept))):
        found = "show nothing but the background"
        raise InvalidScene(Problem("the pictures", found, "an object in front of it, in one of them at least"))
    return views


def _resized(camera: Camera, pixels: Pixels) -> Camera:
    """The camera in its picture's size. Raises InvalidScene where that is no smaller or larger print of its view."""
    height, width = pixels.shape[:2]
    if (width, height) == (camera.width, camera.height):
        return camera
    # Both edges of a print are rounded.
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        place = f"picture {camera.picture or camera.name}"
        allowed = f"the shape of its camera's {camera.width}x{camera.height}"
        raise InvalidScene(Problem(place, f"has {width}x{height} pixels", allowed))
    return camera.resized(width, height)


def cut_out(pixels: Pixels, mask: Pixels) -> Pixels:
    """A picture with a mask for its alpha, both (H, W, 4) uint8: the mask's own, or else its brightest channel.

    Raises InvalidScene for a mask of another size.
    """
    if mask.shape != pixels.shape:
        (height, width), (rows, columns) = mask.shape[:2], pixels.shape[:2]
        raise InvalidScene(Problem("the mask", f"has {width}x{height} pixels", f"{columns}x{rows}, as its picture"))
    alpha = mask[..., 3]
    if int(alpha.min()) == 255:
        alpha = mask[..., :3].max(axis=2)
    return memory.kept(np.concatenate([pixels[..., :3], alpha[..., None]], axis=2))


def _plain_background(pictures: list[Pixels], told: Colour | None) -> Colour:
    """The colour at the pictures' edges. Raises InvalidScene where too few of their pixels have it, or that told."""
    counts = np.zeros((3, 256), np.int64)
    for edge in _edges(pictures):
        for channel in range(3):
            counts[channel] += np.bincount(edge[:, channel], minlength=256)
    total = int(counts[0].sum())
    median = [int(np.argmax(2 * np.cumsum(row) >= total)) for row in counts]
    colour = told or (median[0] / 255, median[1] / 255, median[2] / 255)
    alike = sum(int(near_colour(edge, colour).sum()) for edge in _edges(pictures))
    if alike < PLAIN_SHARE * total:
        words = ",".join(str(round(255 * value)) for value in colour)
        found = f"show scenery behind the object: only {100 * alike // total} % of their edges are near {words}"
        allowed = f"alpha, a plain background ({100 * PLAIN_SHARE:.0f} % or more), or `masks=DIR`"
        raise InvalidScene(Problem("the pictures", found, allowed))
    return colour


def _edges(pictures: list[Pixels]) -> Iterator[Pixels]:
    """(m, 4) the outermost pixels of each picture."""
    for pixels in pictures:
        yield np.concatenate([pixels[0], pixels[-1], pixels[1:-1, 0], pixels[1:-1, -1]])
