from __future__ import annotations

import io
import zlib

import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image as Pillow

from nerfbake.errors import InvalidFile, MemoryLimit
from nerfbake.formats.picture import png as image_png
from nerfbake.memory import memory_limit
from nerfbake.scene.image import Image


def picture(background: tuple[float, float, float] | None) -> Image:
    random = np.random.default_rng(0)
    alpha = random.uniform(0.2, 1, (5, 7)).astype(np.float32)
    colour = random.uniform(0, 1, (5, 7, 3)).astype(np.float32) * alpha[..., None]
    return Image(colour, alpha, np.zeros_like(alpha), background)


@pytest.mark.parametrize("background", [None, (1.0, 1.0, 1.0)])
def test_what_is_written_is_read_and_pillow_reads_it_too(background: tuple[float, float, float] | None) -> None:
    image = picture(background)
    data = b"".join(image_png.encode(image))
    assert image_png.recognise(memoryview(data[:512]))
    with Pillow.open(io.BytesIO(data)) as seen:
        assert seen.mode == ("RGBA" if background is None else "RGB")
        assert np.asarray(seen).tobytes() == image.pixels.tobytes()
    back = image_png.decode(memoryview(data))
    assert_allclose(back.colour, image.colour, atol=3 / 255)
    if background is None:
        assert_allclose(back.alpha, image.alpha, atol=1 / 255)


def test_grey_of_16_bits_is_not_white() -> None:
    file = io.BytesIO()
    Pillow.fromarray(np.array([[0, 1000, 32896, 65535]], np.uint16)).save(file, "PNG")
    found = image_png.decode(memoryview(file.getvalue()))
    assert_allclose(found.colour[0, :, 0] * 255, [0, 3, 128, 255])


def test_hostile_pictures_are_refused() -> None:
    good = b"".join(image_png.encode(picture(None)))
    huge = bytearray(good)
    huge[16:24] = (30000).to_bytes(4, "big") * 2
    huge[29:33] = zlib.crc32(bytes(huge[12:29])).to_bytes(4, "big")
    for data in (good[:50], good[:-30], b"\x89PNG\r\n\x1a\n", bytes(huge), good[:8] + bytes(100)):
        with pytest.raises(InvalidFile, match="allowed"):
            image_png.decode(memoryview(data))
    with pytest.raises(MemoryLimit), memory_limit(100):
        image_png.decode(memoryview(good))
