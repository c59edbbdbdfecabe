"""PNG and JPEG textures: 8-bit RGB, read as if a stranger had sent them, written the same everywhere."""

from __future__ import annotations

import io
import warnings
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from nerfbake.errors import InvalidFile, MemoryLimit, Problem

MAX_EDGE = 16384
_COMPRESSION = 3  # zlib's level: files 3 to 14 % larger than at 6, written in a third of the time
_BROKEN = (OSError, SyntaxError, ValueError, EOFError, IndexError, KeyError, TypeError, OverflowError)


def decode_texture(view: memoryview, name: str, *, max_memory: int, any_mode: bool = False) -> npt.NDArray[np.uint8]:
    """(H, W, 3) uint8, row 0 at the top. Sizes are settled from the header, before anything is inflated.

    Raises InvalidFile for anything but a whole PNG or JPEG of 8-bit RGB, MemoryLimit for one above max_memory.
    any_mode: greys, palettes and alpha are turned into RGB instead, for pictures that are only looked at.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # large images are ours to refuse
            with Image.open(io.BytesIO(view), formats=["PNG", "JPEG"]) as image:
                width, height = image.size
                if max(width, height) > MAX_EDGE:
                    raise InvalidFile(Problem(name, f"declares {width:,}x{height:,} texels", f"{MAX_EDGE:,} an edge"))
                if 3 * width * height > max_memory:
                    raise MemoryLimit(name, 3 * width * height, max_memory)
                if any_mode:
                    return np.asarray(image.convert("RGB"))
                if image.mode != "RGB":
                    raise InvalidFile(Problem(name, f"holds {image.mode} texels", "RGB, 8 bits a channel"))
                return np.asarray(image)
    except Image.DecompressionBombError:
        raise InvalidFile(Problem(name, "declares more than 178 million texels", f"{MAX_EDGE:,} an edge")) from None
    except _BROKEN as error:
        raise InvalidFile(Problem(name, f"cannot be read ({error})", "a whole PNG or JPEG")) from None


def encode_texture(texels: npt.NDArray[np.uint8]) -> bytes:
    """A PNG of (H, W, 3) uint8, without loss, colour profile or date."""
    file: Any = io.BytesIO()
    Image.fromarray(texels).save(file, "PNG", compress_level=_COMPRESSION)
    return bytes(file.getvalue())
