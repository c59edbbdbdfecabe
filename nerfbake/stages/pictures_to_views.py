"""Cameras and their pictures -> views: cameras scaled to their pictures, and the background colour."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Literal, NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.image import WHITE
from nerfbake.scene.packed_pictures import PackedPicture, PackedPictures, Pixels
from nerfbake.scene.views import Views, near_colour

_WHITE = 128  # of 255: least brightness of a mask where it is brightest
PLAIN_SHARE = 0.7  # of the pixels along the pictures' edges; below 1, because the object may be cut off

Colour = tuple[float, float, float]
Scenery = Literal["auto", "keep", "drop"]


class PosedPicture(NamedTuple):
    """A picture and its camera, in the picture's size.

    size: width and height before it was reduced by `factor`. edge (m, 4): its outermost pixels. alpha: the least and
    the largest one.
    """

    camera: Camera
    packed: PackedPicture
    size: tuple[int, int]
    factor: int
    edge: Pixels
    alpha: tuple[int, int]


def build_views(
    cameras: Cameras,
    pictures: Iterable[Pixels],
    *,
    background: Colour | None = None,
    scenery: Scenery = "auto",
    rough: bool = False,
    edge: int | None = None,
) -> Views:
    """Combine cameras with their pictures, (H, W, 4) uint8 of straight sRGB colour and alpha.

    A camera is resized if its size differs from its picture's, but the aspect ratio is the same. background: the sRGB
    colour in 0..1 behind the object; None: white if any picture has alpha, else the median of the pixels along the
    pictures' edges. In pictures without alpha, 70 % of these pixels have that colour (+-16 of 255) if they show an
    object without scenery.

    scenery: keep fits everything that the pictures show, where alpha is 255, over the mean of all these pixels; drop
    fits an object in front of a background; auto keeps it if the pictures show scenery behind the object and have no
    alpha, and no background was given. rough: alpha comes from masks that may cut off parts of the object. edge: the
    pixels that the shorter edge of a picture may have; a larger picture is reduced by a whole factor.

    Raises InvalidScene for a picture with another aspect ratio than its camera's, for scenery that is not to be kept,
    for pictures that show only background, and for a picture that has no pixel that is used.

    >>> import numpy as np
    >>> from nerfbake import Camera, Cameras, build_views
    >>> cameras = Cameras((Camera(800, 600, 1000.0, np.eye(4), "front"),))
    >>> picture = np.full((3, 4, 4), 255, np.uint8)
    >>> picture[1, 1, :3] = 0
    >>> views = build_views(cameras, [picture])
    >>> views.cameras.cameras[0].fx, views.background, views.masked
    (5.0, (1.0, 1.0, 1.0), False)
    """
    posed = [pose_picture(*each, edge=edge) for each in zip(cameras.cameras, pictures, strict=False)]
    return join_pictures(cameras, posed, background=background, scenery=scenery, rough=rough)


def pose_picture(camera: Camera, pixels: Pixels, *, edge: int | None = None) -> PosedPicture:
    """Return one picture of build_views(). Raises InvalidScene, MemoryLimit."""
    (height, width), factor = pixels.shape[:2], 1
    camera = resized_to(camera, width, height)
    if edge is not None and (factor := -(-min(width, height) // edge)) > 1:
        from nerfbake.kernels.picture.reduction import reduced_picture  # here, because it imports numba

        camera, pixels = camera.reduced(factor), reduced_picture(pixels, factor)
    alpha = int(pixels[..., 3].min()), int(pixels[..., 3].max())
    return PosedPicture(camera, PackedPicture(pixels), (width, height), factor, _edge(pixels), alpha)


def join_pictures(
    cameras: Cameras,
    pictures: Sequence[PosedPicture],
    *,
    background: Colour | None = None,
    scenery: Scenery = "auto",
    rough: bool = False,
) -> Views:
    """Combine the pictures of all cameras, as build_views() does. Raises InvalidScene."""
    fitting, packed, *_, edges, alphas = zip(*pictures, strict=True) if pictures else [()] * 6
    if len(packed) != len(cameras.cameras):
        raise InvalidScene(Problem("pictures", f"are {len(packed):,}", f"{len(cameras.cameras):,}, one a camera"))
    kept = PackedPictures(packed)
    masked = any(least < 255 for least, _ in alphas)
    posed = replace(cameras, cameras=fitting)
    if scenery == "keep" or (scenery == "auto" and not masked and background is None and not _is_plain(edges)):
        _require_used(posed, [most for _, most in alphas])
        return Views(posed, kept, background or _mean(kept), masked, True)
    behind = (background or WHITE) if masked else _plain_background(edges, background)
    views = Views(posed, kept, behind, masked, rough=rough and masked)
    if all(views.behind(i).all() for i in range(len(kept))):
        found = "show nothing but the background"
        raise InvalidScene(Problem("the pictures", found, "an object in front of it in at least one picture"))
    return views


def _require_used(cameras: Cameras, most: Sequence[int]) -> None:
    """Raise InvalidScene if a picture with scenery has no pixel that is used. most: the largest alpha of each."""
    for camera, alpha in zip(cameras.cameras, most, strict=True):
        if alpha < 255:
            place = f"picture {camera.picture or camera.name}"
            raise InvalidScene(Problem(place, "has no pixel with alpha 255", "a mask that is white somewhere"))


def resized_to(camera: Camera, width: int, height: int) -> Camera:
    """Return the camera in its picture's size. Raises InvalidScene if the aspect ratios differ."""
    if (width, height) == (camera.width, camera.height):
        return camera
    # Both edges of a scaled picture are rounded.
    if abs(width * camera.height - height * camera.width) > max(camera.width, camera.height):
        place = f"picture {camera.picture or camera.name}"
        allowed = f"the shape of its camera's {camera.width}x{camera.height}"
        raise InvalidScene(Problem(place, f"has {width}x{height} pixels", allowed))
    return camera.resized(width, height)


def apply_mask(pixels: Pixels, mask: Pixels) -> Pixels:
    """Return a picture with a mask as its alpha, both (H, W, 4) uint8.

    The mask's alpha is used, or its brightest channel if it is opaque. Raises InvalidScene if the sizes differ, and for
    a mask that is dark everywhere and not black, such as one of the labels 0 and 1.
    """
    if mask.shape != pixels.shape:
        (height, width), (rows, columns) = mask.shape[:2], pixels.shape[:2]
        raise InvalidScene(Problem("the mask", f"has {width}x{height} pixels", f"{columns}x{rows}, as its picture"))
    alpha = mask[..., 3]
    if int(alpha.min()) == 255:
        alpha = mask[..., :3].max(axis=2)
    if 0 < (brightest := int(alpha.max())) < _WHITE:
        allowed = "255 (white) where the object is, or 0 everywhere"
        raise InvalidScene(Problem("the mask", f"is {brightest} at its brightest", allowed))
    return memory.kept(np.concatenate([pixels[..., :3], alpha[..., None]], axis=2))


def _plain_background(edges: Sequence[Pixels], given: Colour | None) -> Colour:
    """Return `given`, or else the median colour along the pictures' edges.

    Raises InvalidScene if too few pixels of the edges have this colour.
    """
    colour, alike = _edge_colour(edges, given)
    if alike < PLAIN_SHARE:
        words = ",".join(str(round(255 * value)) for value in colour)
        found = f"show scenery behind the object: only {int(100 * alike)} % of their edges are near {words}"
        allowed = f"alpha, a plain background ({100 * PLAIN_SHARE:.0f} % or more), `masks=DIR`, or `scenery=keep`"
        raise InvalidScene(Problem("the pictures", found, allowed))
    return colour


def _is_plain(edges: Sequence[Pixels]) -> bool:
    return _edge_colour(edges, None)[1] >= PLAIN_SHARE


def _mean(pictures: Sequence[Pixels]) -> Colour:
    """Return the mean colour of all pixels with alpha 255."""
    sums, count = np.zeros(3), 0
    for pixels in pictures:
        used = pixels[..., 3] == 255
        sums += pixels[used, :3].sum(axis=0, dtype=np.int64)
        count += int(np.count_nonzero(used))
    red, green, blue = (sums / (255 * count)).tolist()
    return red, green, blue


def _edge_colour(edges: Sequence[Pixels], given: Colour | None) -> tuple[Colour, float]:
    """Return `given`, or else the median colour along the pictures' edges, and the share of their pixels near it."""
    counts = np.zeros((3, 256), np.int64)
    for edge in edges:
        for channel in range(3):
            counts[channel] += np.bincount(edge[:, channel], minlength=256)
    total = int(counts[0].sum())
    median = [int(np.argmax(2 * np.cumsum(row) >= total)) for row in counts]
    colour = given or (median[0] / 255, median[1] / 255, median[2] / 255)
    alike = sum(int(near_colour(edge, colour).sum()) for edge in edges)
    return colour, alike / total


def _edge(pixels: Pixels) -> Pixels:
    """Return the outermost pixels (m, 4) of a picture."""
    return np.concatenate([pixels[0], pixels[-1], pixels[1:-1, 0], pixels[1:-1, -1]])
