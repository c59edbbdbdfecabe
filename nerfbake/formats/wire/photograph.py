"""Photographs as they are in their files: 8-bit sRGB and straight alpha, of a PNG or a JPEG.

Nothing is turned by what EXIF says of the camera: poses were found on the pixels as they stand.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.picture import opened, png_of

_MODES = ("1", "L", "LA", "P", "PA", "RGB", "RGBA")


def decode_photograph(view: memoryview) -> npt.NDArray[np.uint8]:
    """(H, W, 4) uint8, row 0 at the top; alpha is 255 where the file has none. Raises InvalidFile, MemoryLimit."""
    with opened(view, "the picture", "PNG", "JPEG", bytes_per_pixel=12) as picture:
        if picture.mode not in _MODES:
            found = f"holds {picture.mode} pixels"
            raise InvalidFile(Problem("the picture", found, "grey, a palette or RGB, 8 bits a channel"))
        return np.asarray(picture.convert("RGBA"))


def encode_thumbnail(view: memoryview, edge: int) -> bytes:
    """A PNG of at most so many pixels along each edge, of a PNG, a JPEG or the first picture of a GIF; one that is
    smaller keeps its size. Raises InvalidFile, MemoryLimit.
    """
    with opened(view, "the picture", "PNG", "JPEG", "GIF", bytes_per_pixel=12) as picture:
        small = picture.convert("RGBA")
        small.thumbnail((edge, edge), Image.Resampling.BOX)
        return png_of(small)
