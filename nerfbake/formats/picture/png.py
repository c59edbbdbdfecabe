"""Read and write pictures as PNG: 8-bit sRGB, with straight alpha if there is no background."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from PIL import Image as Pillow

from nerfbake.formats.wire.picture import opened, photograph_of, png_of
from nerfbake.scene.image import Image


def recognise(view: memoryview) -> bool:
    """True for the signature of a PNG."""
    return bytes(view[:8]) == b"\x89PNG\r\n\x1a\n"


def encode(image: Image) -> Iterator[bytes]:
    yield png_of(Pillow.fromarray(image.pixels))


def decode(view: memoryview) -> Image:
    """Read a picture; if it has alpha, the colours are premultiplied."""
    with opened(view, "PNG", "PNG", bytes_per_pixel=24) as picture:
        transparent = picture.mode in ("RGBA", "LA") or "transparency" in picture.info
        pixels = photograph_of(picture)
    colour, alpha = np.empty((*pixels.shape[:2], 3), np.float32), np.empty(pixels.shape[:2], np.float32)
    # Dividing in place saves eleven bytes a pixel, of up to 268 million pixels, and half the time.
    np.divide(pixels[..., 3], np.float32(255), out=alpha)
    np.divide(pixels[..., :3], np.float32(255), out=colour)
    if transparent:
        colour *= alpha[..., None]
    return Image(colour, alpha, np.zeros_like(alpha), None if transparent else (1.0, 1.0, 1.0))
