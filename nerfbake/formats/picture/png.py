"""Pictures as PNG: 8-bit sRGB, with straight alpha where there is no background. Depth has files of its own."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from PIL import Image as Pillow

from nerfbake.formats.wire.picture import opened, png_of
from nerfbake.scene.image import Image


def recognise(view: memoryview) -> bool:
    """True for a PNG's signature and colours."""
    return bytes(view[:8]) == b"\x89PNG\r\n\x1a\n"


def encode(image: Image) -> Iterator[bytes]:
    yield png_of(Pillow.fromarray(image.pixels))


def decode(view: memoryview) -> Image:
    """The picture; colours premultiplied by alpha where it has one."""
    with opened(view, "PNG", "PNG", bytes_per_pixel=28) as picture:
        transparent = picture.mode in ("RGBA", "LA") or "transparency" in picture.info
        pixels = np.asarray(picture.convert("RGBA"))
    colour, alpha = np.empty((*pixels.shape[:2], 3), np.float32), np.empty(pixels.shape[:2], np.float32)
    # Into its place: eleven bytes less for each pixel, of which there may be 268 million, and half the time.
    np.divide(pixels[..., 3], np.float32(255), out=alpha)
    np.divide(pixels[..., :3], np.float32(255), out=colour)
    if transparent:
        colour *= alpha[..., None]
    return Image(colour, alpha, np.zeros_like(alpha), None if transparent else (1.0, 1.0, 1.0))
