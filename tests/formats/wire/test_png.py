"""Single flipped bits in the pixels of PNG files are errors, wherever the pixels are data."""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from PIL import Image as Pillow

from nerfbake.errors import InvalidFile
from nerfbake.formats.picture import depth_png, png
from nerfbake.formats.wire.picture import (
    check_photograph,
    decode_photograph,
    decode_texture,
    encode_preview,
    encode_thumbnail,
    size_of,
)

TEXELS = np.random.default_rng(1).integers(0, 256, (9, 12, 3), np.uint8)


def png_of(texels: Any) -> bytes:
    file = io.BytesIO()
    Pillow.fromarray(texels).save(file, "PNG")
    return file.getvalue()


def one_bit_changes(whole: bytes) -> list[bytes]:
    """The file with each fifth bit of its first IDAT flipped: length, type, data and CRC."""
    at = whole.index(b"IDAT") - 4
    size = 12 + int.from_bytes(whole[at : at + 4], "big")
    found = []
    for bit in range(8 * at, 8 * (at + size), 5):
        broken = bytearray(whole)
        broken[bit // 8] ^= 1 << bit % 8
        found.append(bytes(broken))
    return found


@pytest.mark.parametrize(
    ("decode", "whole"),
    [
        (lambda view: decode_texture(view, "a.png"), png_of(TEXELS)),
        (lambda view: decode_texture(view, "a.png", any_mode=True), png_of(TEXELS[..., 0])),
        (decode_photograph, png_of(np.dstack([TEXELS, TEXELS[..., 0]]))),
        (check_photograph, png_of(TEXELS)),
        (png.decode, png_of(TEXELS)),
        (depth_png.decode, png_of(TEXELS[..., 0].astype(np.uint16) * 250)),
    ],
)
def test_no_flipped_bit_becomes_other_pixels(decode: Callable[[memoryview], Any], whole: bytes) -> None:
    decode(memoryview(whole))
    for broken in one_bit_changes(whole):
        with pytest.raises(InvalidFile):
            decode(memoryview(broken))


def test_the_error_names_the_place_and_both_checksums() -> None:
    whole = bytearray(png_of(TEXELS))
    at = whole.index(b"IDAT")
    whole[at + 20] ^= 4
    with pytest.raises(InvalidFile, match=r"a\.png is damaged: its pixels at byte 33 have CRC-32 .{8}; allowed: .{8},"):
        decode_texture(memoryview(bytes(whole)), "a.png")


def chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def test_pixels_in_many_chunks_with_others_behind_them() -> None:
    whole = png_of(TEXELS)
    at = whole.index(b"IDAT") - 4
    size = int.from_bytes(whole[at : at + 4], "big")
    body = whole[at + 8 : at + 8 + size]
    parts = [chunk(b"IDAT", body[k : k + 7]) for k in range(0, size, 7)]
    many = whole[:at] + b"".join([*parts, chunk(b"IDAT", b""), chunk(b"tEXt", b"a\0b"), chunk(b"IEND", b""), b"IDAT"])
    np.testing.assert_array_equal(decode_texture(memoryview(many), "a.png"), TEXELS)


def test_the_size_is_known_from_the_head_alone() -> None:
    assert size_of(png_of(TEXELS)[:50], "a.png") == (12, 9)


@pytest.mark.parametrize("size", [None, (32, 24), (24, 32)])
def test_a_damaged_photograph_has_no_pixels_whatever_its_camera(size: tuple[int, int] | None) -> None:
    """The EXIF data of a PNG may follow its pixels: to look for them decodes the picture."""
    head = png_of(np.zeros((24, 32, 4), np.uint8))[: 8 + 25]
    broken = memoryview(head + chunk(b"IDAT", 50 * b"abc") + chunk(b"IEND", b""))
    for read in (
        lambda: decode_photograph(broken, size),
        lambda: encode_preview(broken, 8, size),
        lambda: encode_thumbnail(broken, 8),
    ):
        with pytest.raises(InvalidFile, match="cannot be read"):
            read()
