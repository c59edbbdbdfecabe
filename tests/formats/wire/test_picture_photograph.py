"""Photographs as their files have them."""

from __future__ import annotations

import io
import struct
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image as Pillow
from pillow_heif import from_pillow

from nerfbake.errors import InvalidFile, MemoryLimit, NerfbakeError
from nerfbake.formats.wire.picture import (
    check_photograph,
    decode_photograph,
    decode_texture,
    encode_preview,
    encode_thumbnail,
    is_heic,
    jpeg_of_heic,
)
from nerfbake.memory import memory_limit
from tests.support.heic import EXIF, FOCAL, FOCAL_LENGTH, ORIENTATION, heic_of
from tests.support.hostile import damaged

SMOOTH = np.stack(np.broadcast_arrays(*np.ogrid[0:240:48j, 0:190:64j], 99), axis=-1).astype(np.uint8)
PIXELS = np.random.default_rng(3).integers(0, 256, (5, 7, 4), np.uint8)


def file(picture: Pillow.Image, kind: str = "PNG", **options: Any) -> memoryview:
    made = io.BytesIO()
    picture.save(made, kind, **options)
    return memoryview(made.getvalue())


def test_colour_and_alpha_are_those_of_the_file() -> None:
    assert_array_equal(decode_photograph(file(Pillow.fromarray(PIXELS))), PIXELS)
    opaque = decode_photograph(file(Pillow.fromarray(PIXELS[..., :3])))
    assert_array_equal(opaque[..., :3], PIXELS[..., :3])
    assert (opaque[..., 3] == 255).all()


def test_greys_palettes_and_jpegs_are_turned_into_the_same() -> None:
    grey = decode_photograph(file(Pillow.fromarray(PIXELS[..., 0])))
    assert_array_equal(grey[..., :3], np.repeat(PIXELS[..., :1], 3, axis=2))
    palette = Pillow.new("P", (2, 1), 1)
    palette.putpalette([0, 0, 0, 10, 20, 30])
    assert_array_equal(decode_photograph(file(palette, transparency=1)), [[[10, 20, 30, 0]] * 2])
    flat = Pillow.new("RGB", (9, 8), (200, 100, 50))
    assert np.abs(decode_photograph(file(flat, "JPEG"))[..., :3].astype(int) - [200, 100, 50]).max() <= 3


def test_pixels_stand_as_they_are_whatever_exif_says() -> None:
    exif = Pillow.Exif()
    exif[0x0112] = 6  # turn by 90 degrees before it is shown
    assert decode_photograph(file(Pillow.new("RGB", (9, 8)), "JPEG", exif=exif)).shape == (8, 9, 4)


@pytest.mark.parametrize(
    ("picture", "kind", "said"),
    [
        (Pillow.fromarray(np.zeros((3, 3), np.uint16)), "PNG", "holds I;16 pixels; allowed: grey, a palette or RGB"),
        (Pillow.new("CMYK", (3, 3)), "JPEG", "holds CMYK pixels"),
        (Pillow.new("RGB", (3, 3)), "BMP", r"cannot be read \(it is a BMP\); allowed: a whole PNG or JPEG"),
        (Pillow.new("RGB", (3, 3)), "GIF", r"cannot be read \(it is a GIF\)"),
        (Pillow.new("RGB", (3, 3)), "TIFF", r"cannot be read \(it is a TIFF or a raw photograph\)"),
        (Pillow.new("RGB", (3, 3)), "WEBP", r"cannot be read \(it is a WebP\)"),
        (Pillow.new("RGB", (3, 3)), "AVIF", r"cannot be read \(it is an AVIF\); allowed: a whole PNG or JPEG"),
        (Pillow.new("L", (20_000, 1)), "PNG", "declares 20,000x1 pixels"),
    ],
)
def test_what_is_no_photograph_of_8_bits_is_refused(picture: Pillow.Image, kind: str, said: str) -> None:
    with pytest.raises(InvalidFile, match=said):
        decode_photograph(file(picture, kind))


@pytest.mark.parametrize("head", [b"\xff\x0a", b"\0\0\0\x0cJXL \r\n\x87\n"])
def test_a_jpeg_xl_is_named(head: bytes) -> None:
    with pytest.raises(InvalidFile, match=r"the picture cannot be read \(it is a JPEG XL\)"):
        decode_photograph(memoryview(head + bytes(64)))


@pytest.mark.parametrize(("brand", "kind"), [(b"qt  ", "a video"), (b"crx ", "a raw photograph"), (b"avis", "an AVIF")])
def test_other_files_of_boxes_are_no_heic(brand: bytes, kind: str) -> None:
    data = memoryview(b"\0\0\0\x14ftyp" + brand + bytes(64))
    assert not is_heic(data)
    with pytest.raises(
        InvalidFile, match=rf"the picture cannot be read \(it is {kind}\); allowed: a whole PNG or JPEG"
    ):
        decode_photograph(data)


def test_a_large_picture_in_a_small_file_is_told_before_it_is_inflated() -> None:
    with memory_limit(4 << 20), pytest.raises(MemoryLimit, match=r"the picture needs 4\.8 MiB"):
        decode_photograph(file(Pillow.new("1", (1000, 1000))))


def test_a_jpeg_with_a_preview_behind_it_takes_as_much_memory_as_one_without() -> None:
    picture = Pillow.fromarray(SMOOTH).resize((256, 256))
    view = file(picture, "MPO", save_all=True, append_images=[picture], progressive=True)
    with memory_limit(900_000), pytest.raises(MemoryLimit, match=r"the picture needs 1\.0 MiB"):  # 16 bytes a pixel
        decode_photograph(view)
    assert_array_equal(decode_photograph(view), decode_photograph(file(picture, "JPEG", progressive=True)))


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_damaged_photograph_is_one_line_or_a_picture(kind: str) -> None:
    for what, data in damaged(bytes(file(Pillow.fromarray(PIXELS[..., :3]), kind)), flips=200):
        try:
            assert decode_photograph(memoryview(data)).shape[2] == 4, what
        except NerfbakeError:
            continue


def test_a_preview_is_small_upright_and_on_white() -> None:
    tall = np.zeros((60, 40, 4), np.uint8)
    tall[:30] = (200, 0, 0, 255)  # the lower half is transparent
    small = Pillow.open(io.BytesIO(encode_preview(file(Pillow.fromarray(tall)), 30)))
    assert (small.format, small.size) == ("JPEG", (20, 30))
    shown = np.asarray(small).astype(int)
    assert np.abs(shown[5, 10] - [200, 0, 0]).max() < 8
    assert np.abs(shown[25, 10] - 255).max() < 8
    assert Pillow.open(io.BytesIO(encode_preview(file(Pillow.fromarray(tall)), 100))).size == (40, 60)


def exif_of(*tags: tuple[int, int, int, bytes]) -> bytes:
    entries = b"".join(struct.pack("<HHI4s", *tag) for tag in tags)
    return b"Exif\0\0II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4)


@pytest.mark.parametrize(
    ("exif", "turned"),
    [
        (exif_of((0x112, 3, 1, struct.pack("<I", 6)), (0x131, 11, 1, struct.pack("<f", 1.0))), True),
        (exif_of((0x112, 3, 9, b"????")), False),
        (b"Exif\0\0II*\0", False),
    ],
)
def test_damaged_exif_says_nothing_about_the_pixels(exif: bytes, turned: bool) -> None:
    view = file(Pillow.new("RGB", (48, 64), (200, 100, 50)), "JPEG", exif=exif)
    assert decode_photograph(view, (64, 48)).shape[:2] == ((48, 64) if turned else (64, 48))
    assert encode_preview(view, 48, (64, 48))


def test_a_grey_picture_of_16_bits_is_shown_with_its_upper_8() -> None:
    view = file(Pillow.fromarray(np.full((3, 4), 20_000, np.uint16)))
    assert (decode_texture(view, "a.png", any_mode=True) == 78).all()
    thumbnail = Pillow.open(io.BytesIO(encode_thumbnail(view, 4)))
    assert thumbnail.convert("RGBA").getpixel((0, 0)) == (78, 78, 78, 255)


@pytest.mark.parametrize("orientation", [5, 6, 7, 8])
def test_a_preview_is_turned_as_the_photograph_is(orientation: int) -> None:
    exif = Pillow.Exif()
    exif[0x0112] = orientation
    corners = np.zeros((32, 48, 3), np.uint8)
    corners[:16, :24] = 255
    view = file(Pillow.fromarray(corners), "JPEG", exif=exif, quality=95)
    whole = decode_photograph(view, (32, 48))[..., :3].astype(int)
    preview = np.asarray(Pillow.open(io.BytesIO(encode_preview(view, 48, (32, 48))))).astype(int)
    assert preview.shape == whole.shape == (48, 32, 3)
    assert np.abs(preview - whole).mean() < 8


@pytest.fixture(scope="module")
def heic() -> memoryview:
    """A lossless HEIC of 64 x 48 pixels, with an EXIF orientation and a focal length."""
    return memoryview(heic_of(Pillow.fromarray(SMOOTH), quality=-1))


def test_heic_has_the_pixels_that_it_was_made_of(heic: memoryview) -> None:
    pixels = decode_photograph(heic)
    assert pixels.shape == (48, 64, 4)
    assert np.abs(pixels[..., :3].astype(int) - SMOOTH).max() <= 4
    assert_array_equal(decode_photograph(heic, (48, 64)), pixels)  # never rotated: it is stored upright
    assert Pillow.open(io.BytesIO(encode_preview(heic, 32))).size == (32, 24)
    assert Pillow.open(io.BytesIO(encode_thumbnail(heic, 32))).size == (32, 24)


def test_the_library_without_an_encoder_decodes_the_same(heic: memoryview, monkeypatch: pytest.MonkeyPatch) -> None:
    photographs = [heic, memoryview(heic_of(Pillow.fromarray(SMOOTH)))]
    expected = [decode_photograph(view) for view in photographs]
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    for view, pixels in zip(photographs, expected, strict=True):
        assert_array_equal(decode_photograph(view), pixels)
    assert "pi_heif" in sys.modules


def test_heic_becomes_a_jpeg_of_its_size_and_focal_length(heic: memoryview) -> None:
    made = jpeg_of_heic(heic)
    with Pillow.open(io.BytesIO(made)) as picture:
        assert (picture.format, picture.size) == ("JPEG", (64, 48))
        assert picture.getexif().get_ifd(EXIF)[FOCAL_LENGTH] == FOCAL
        assert picture.getexif()[ORIENTATION] == 1  # a HEIC is decoded upright
    assert is_heic(heic)
    assert not is_heic(memoryview(made))
    assert np.abs(decode_photograph(memoryview(made)).astype(int) - decode_photograph(heic)).max() <= 8


def test_more_exif_than_a_jpeg_holds_is_left_out(heic: memoryview) -> None:
    whole = memoryview(heic_of(Pillow.fromarray(SMOOTH), quality=-1, note=bytes(range(256)) * 300))
    assert len(whole) > 76_000
    assert jpeg_of_heic(whole) == jpeg_of_heic(heic)


@pytest.mark.parametrize("exif", [b"Exif\0\0II*\0", b"Exif\0\0II*\0" + b"\xff" * 4])
def test_damaged_exif_of_heic_is_left_out(exif: bytes) -> None:
    made = io.BytesIO()
    from_pillow(Pillow.fromarray(SMOOTH)).save(made, quality=-1, exif=exif)
    with Pillow.open(io.BytesIO(jpeg_of_heic(memoryview(made.getvalue())))) as picture:
        assert picture.size == (64, 48)
        assert FOCAL_LENGTH not in picture.getexif().get_ifd(EXIF)


def test_damaged_heic_is_refused(heic: memoryview) -> None:
    for _, data in damaged(bytes(heic), flips=100):
        with suppress(NerfbakeError):
            decode_photograph(memoryview(data))
    with pytest.raises(InvalidFile, match=r"the picture cannot be read .*; allowed: a whole HEIF"):
        decode_photograph(heic[: len(heic) // 2])


def test_heic_with_one_damaged_bit_is_one_line_or_a_picture() -> None:
    whole = heic_of(Pillow.fromarray(SMOOTH), quality=60)
    sizes = whole.index(b"ispe") + 8  # width and height: what libheif refuses with RuntimeError
    said = set()
    for bit in (*range(8 * sizes, 8 * sizes + 64), *range(0, 8 * len(whole), 11)):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        said.add(said_of(check_photograph, bytes(data)))
    assert any("Memory allocation error" in line for line in said)
    assert all("cannot be read (" in line or "declares" in line for line in said if line)


@pytest.mark.data
def test_the_damaged_heic_of_the_report_is_one_line(data: Path) -> None:
    view = memoryview((data / "hostile4/heic_runtime/bad.heic").read_bytes())
    with pytest.raises(InvalidFile, match=r"the picture cannot be read \(Memory allocation .*; allowed: a whole HEIF"):
        check_photograph(view)
    view = memoryview((data / "hostile4/heic_exif/exif70k.heic").read_bytes())
    assert Pillow.open(io.BytesIO(jpeg_of_heic(view))).size == decode_photograph(view).shape[1::-1]


def test_without_its_library_heic_is_named(heic: memoryview, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pillow_heif", None)
    monkeypatch.setitem(sys.modules, "pi_heif", None)
    monkeypatch.setattr("nerfbake.formats.wire.heif.command_for", "pip install 'nerfbake[{}]'".format)
    allowed = r"a PNG or a JPEG, or HEIC after: pip install 'nerfbake\[pillow_heif\]'"
    with pytest.raises(InvalidFile, match=f"the picture is HEIC; allowed: {allowed}"):
        decode_photograph(heic)


def said_of(read: Callable[[memoryview], object], data: bytes) -> str:
    try:
        read(memoryview(data))
    except NerfbakeError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_check_finds_what_decoding_finds(kind: str) -> None:
    whole = bytes(file(Pillow.fromarray(SMOOTH), kind))
    assert check_photograph(memoryview(whole)).size == (64, 48)
    said = [
        [said_of(read, data) for _, data in damaged(whole, flips=200)] for read in (check_photograph, decode_photograph)
    ]
    assert said[0] == said[1]
    assert sum(map(bool, said[0])) > 90
