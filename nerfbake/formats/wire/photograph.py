"""Photographs as they are in their files: 8-bit sRGB and straight alpha, of a PNG or a JPEG.

COLMAP, instant-ngp and nerfstudio find poses on the pixels as they are stored, so EXIF's orientation is not followed.
Some captures have poses that were found on pictures that were turned upright first. There the camera is as wide as the
stored picture is high: only then is the picture turned.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageOps

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.picture import opened, png_of

_ORIENTATION, _QUARTER_TURNS = 0x0112, (5, 6, 7, 8)  # EXIF 2.32, table 4
_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")


def decode_photograph(view: memoryview, size: tuple[int, int] | None = None) -> npt.NDArray[np.uint8]:
    """(H, W, 4) uint8, row 0 at the top; alpha is 255 where the file has none.

    size: (W, H) of the camera. A picture whose EXIF orientation is a quarter turn is turned upright if it has the shape
    of the camera only then. Raises InvalidFile, MemoryLimit.
    """
    with opened(view, "the picture", "PNG", "JPEG", bytes_per_pixel=12) as picture:
        if picture.mode not in _MODES:
            found = f"holds {picture.mode} pixels"
            raise InvalidFile(Problem("the picture", found, "grey, a palette or RGB, 8 bits a channel"))
        if size is not None and _lies(picture, size):
            memory.require("the picture", 2 * 12 * picture.width * picture.height)
            return np.asarray(ImageOps.exif_transpose(picture.convert("RGBA")))
        return np.asarray(picture.convert("RGBA"))


def _lies(picture: Image.Image, size: tuple[int, int]) -> bool:
    """True if a picture has its camera's shape only after the quarter turn that EXIF asks for."""
    (width, height), (W, H) = picture.size, size
    if (width > height) == (W > H) or width == height or W == H:
        return False
    return picture.getexif().get(_ORIENTATION) in _QUARTER_TURNS


def encode_thumbnail(view: memoryview, edge: int, colours: int | None = None) -> bytes:
    """A PNG of at most so many pixels along each edge, of a PNG, a JPEG or the first picture of a GIF; one that is
    smaller keeps its size. colours: the size of its palette; None: it has none. Raises InvalidFile, MemoryLimit.
    """
    with opened(view, "the picture", "PNG", "JPEG", "GIF", bytes_per_pixel=12) as picture:
        small = picture.convert("RGBA")
        small.thumbnail((edge, edge), Image.Resampling.BOX)
        return png_of(small if colours is None else small.quantize(colours, Image.Quantize.FASTOCTREE))
