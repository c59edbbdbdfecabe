"""Pictures as PNG: 8-bit sRGB, with straight alpha where there is no background. Depth does not fit: see image_npy."""

from __future__ import annotations

import io
import warnings
from collections.abc import Iterator

import numpy as np
from PIL import Image as Pillow

from nerfbake.errors import InvalidFile, MemoryLimit, Problem
from nerfbake.scene.camera import MAX_EDGE
from nerfbake.scene.image import Image

_COMPRESSION = 3  # zlib's level: a third of the time of 6, for a few percent more bytes
_BROKEN = (OSError, SyntaxError, ValueError, EOFError, IndexError, KeyError, TypeError, OverflowError)


def recognise(head: bytes) -> bool:
    """True for a PNG's signature."""
    return head[:8] == b"\x89PNG\r\n\x1a\n"


def encode(image: Image) -> Iterator[bytes]:
    file = io.BytesIO()
    Pillow.fromarray(image.pixels).save(file, "PNG", compress_level=_COMPRESSION)
    yield file.getvalue()


def decode(view: memoryview, *, max_memory: int) -> Image:
    """The picture; colours premultiplied by alpha where it has one. Sizes are settled before anything is inflated."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # large images are ours to refuse
            with Pillow.open(io.BytesIO(view), formats=["PNG"]) as picture:
                width, height = picture.size
                if max(width, height) > MAX_EDGE:
                    raise InvalidFile(Problem("PNG", f"declares {width:,}x{height:,} pixels", f"{MAX_EDGE:,} an edge"))
                if (need := 24 * width * height) > max_memory:
                    raise MemoryLimit("the picture", need, max_memory)
                transparent = picture.mode in ("RGBA", "LA") or "transparency" in picture.info
                pixels = np.asarray(picture.convert("RGBA")).astype(np.float32) / np.float32(255)
    except Pillow.DecompressionBombError:
        raise InvalidFile(Problem("PNG", "declares more pixels than a picture has", f"{MAX_EDGE:,} an edge")) from None
    except _BROKEN as error:
        raise InvalidFile(Problem("PNG", f"cannot be read ({error})", "a whole PNG")) from None
    alpha = pixels[..., 3]
    colour = pixels[..., :3] * alpha[..., None] if transparent else pixels[..., :3]
    return Image(colour, alpha, np.zeros_like(alpha), None if transparent else (1.0, 1.0, 1.0))
