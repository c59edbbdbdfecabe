"""PNG and JPEG textures: 8-bit RGB."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from PIL import Image

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.wire.picture import opened, png_of


def decode_texture(view: memoryview, name: str, *, any_mode: bool = False) -> npt.NDArray[np.uint8]:
    """(H, W, 3) uint8, row 0 at the top. Raises InvalidFile for anything but a whole PNG or JPEG of 8-bit RGB.

    any_mode: greys, palettes and alpha are turned into RGB instead, for pictures that are only looked at.
    """
    with opened(view, name, "PNG", "JPEG", bytes_per_pixel=3) as image:
        if any_mode:
            return np.asarray(image.convert("RGB"))
        if image.mode != "RGB":
            raise InvalidFile(Problem(name, f"holds {image.mode} texels", "RGB, 8 bits a channel"))
        return np.asarray(image)


def encode_texture(texels: npt.NDArray[np.uint8]) -> bytes:
    """A PNG of (H, W, 3) uint8, without loss."""
    return png_of(Image.fromarray(texels))
