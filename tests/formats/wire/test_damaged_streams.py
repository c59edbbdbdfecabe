"""Each decoder of another library turns all errors of that library into InvalidFile.

OWN_LIBRARY in tests/rules/test_imports.py lists the files that use such libraries.
"""

from __future__ import annotations

import gzip
import io
import random
import zipfile
import zlib
from collections.abc import Callable
from contextlib import suppress
from typing import Any, NamedTuple

import blosc
import bson
import numpy as np
import pytest
import zstandard
from PIL import Image

from nerfbake.errors import NerfbakeError
from nerfbake.formats.octree.bson import elements_of
from nerfbake.formats.wire import picture
from nerfbake.formats.wire.blosc import unblosc
from nerfbake.formats.wire.colour_profile import into_srgb
from nerfbake.formats.wire.deflate import gunzip, inflate
from nerfbake.formats.wire.json import parse
from nerfbake.formats.wire.video import opened_video
from nerfbake.formats.wire.yaml import parse_map
from nerfbake.formats.wire.zip_reader import ZipReader
from nerfbake.formats.wire.zstd import decompress, decompress_exactly
from tests.rules.test_imports import OWN_LIBRARY
from tests.support.heic import heic_of
from tests.support.pngs import chunks_of, png_of_chunks
from tests.support.profiles import DISPLAY_P3, SRGB_CURVE, profile_of
from tests.support.videos import video_of

DATA = bytes(range(256)) * 8
PIXELS = np.random.default_rng(0).integers(0, 256, (12, 16, 3), np.uint8)


class Decoder(NamedTuple):
    """module: in nerfbake, that calls the library. decode: with valid files that it can read."""

    module: str
    decode: Callable[[memoryview], Any]
    valid: tuple[bytes, ...]


def picture_as(kind: str, **options: Any) -> bytes:
    file = io.BytesIO()
    Image.fromarray(PIXELS).save(file, kind, **options)
    return file.getvalue()


def zipped() -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("a", DATA)
    return file.getvalue()


def unzipped(view: memoryview) -> None:
    reader = ZipReader(view, "a zip archive")
    for name in reader.members:
        reader.unpacked(name, name)


def photographs(view: memoryview) -> None:
    for decode in (
        lambda: picture.decode_photograph(view, (12, 16)),
        lambda: picture.check_photograph(view),
        lambda: picture.encode_thumbnail(view, 8),
        lambda: picture.decode_texture(view, "the texture", any_mode=True, webp=True),
    ):
        with suppress(NerfbakeError):
            decode()


def frames(view: memoryview) -> None:
    with opened_video(io.BytesIO(view)) as video:
        for frame in video:
            frame.pixels()


def decoders() -> dict[str, Decoder]:
    size = len(DATA)
    zstd = zstandard.ZstdCompressor(write_checksum=True).compress(DATA)
    shades = (Image.fromarray(PIXELS[::-1].copy()),)
    animation = picture_as("PNG", save_all=True, append_images=shades, dpi=(72, 72))
    exif = Image.Exif()
    exif[0x0112] = 6
    document = bson.encode({"a": 1.5, "b": "text", "c": [1, 2, {"q": None}], "e": 2**40})
    settings = (
        b'%YAML 1.1\n---\na: &i !!x/y\n- "\\x41\\u00e9"\n- {b: 1.0e-15, c: [~, yes]}\nd: *i\ne: |\n  f\ng: 0x1F # h\n'
    )
    return {
        "zstd": Decoder("formats/wire/zstd", decompress, (zstd,)),
        "zstd exactly": Decoder("formats/wire/zstd", lambda view: decompress_exactly(view, size, "x"), (zstd,)),
        "blosc": Decoder("formats/wire/blosc", lambda view: unblosc(view, size, "x"), (blosc.compress(DATA, 4),)),
        "zlib": Decoder("formats/wire/deflate", lambda view: inflate(view, size, "x"), (zlib.compress(DATA),)),
        "gzip": Decoder("formats/wire/deflate", lambda view: gunzip(view, "x"), (gzip.compress(DATA),)),
        "zip": Decoder("formats/wire/zip_reader", unzipped, (zipped(),)),
        "json": Decoder("formats/wire/json", lambda view: parse(view, "x", comments=True), (b'{"a": [1, "x"]} // c',)),
        "yaml": Decoder("formats/wire/yaml", lambda view: parse_map(view, "x"), (settings,)),
        "bson": Decoder("formats/octree/bson", lambda view: elements_of(view, "x"), (document,)),
        "profile": Decoder(
            "formats/wire/colour_profile",
            lambda view: into_srgb(Image.new("RGBA", (4, 4)), bytes(view)),
            (profile_of(DISPLAY_P3, SRGB_CURVE),),
        ),
        "heic": Decoder("formats/wire/heif", photographs, (heic_of(Image.fromarray(PIXELS)),)),
        "video": Decoder(
            "formats/wire/video", frames, tuple(video_of([PIXELS / 255] * 2, ending) for ending in (".mp4", ".mkv"))
        ),
        "pictures": Decoder(
            "formats/wire/picture",
            photographs,
            (
                picture_as("PNG"),
                animation,
                picture_as("JPEG", exif=exif.tobytes()),
                picture_as("WEBP", lossless=True),
                picture_as("GIF", save_all=True, append_images=shades),
            ),
        ),
    }


ENCODE_ONLY = {
    "flatbuffers",
    "json",
    "npz",
    "folder",
    "gif",
    "png",
    "depth_png",
    "package",
    "text",
    "_child",  # whose own tests damage stages
}  # or read through formats/wire/picture


def test_every_library_that_decodes_is_in_the_table() -> None:
    used = {module for module in OWN_LIBRARY if module.startswith("formats/")}
    tried = {decoder.module for decoder in decoders().values()}
    assert {module.rpartition("/")[2] for module in used - tried} == ENCODE_ONLY


def damaged(data: bytes, dice: random.Random) -> bytes:
    if data.startswith(b"\x89PNG") and dice.random() < 0.7:  # otherwise the checksum would reject most damage
        chunks = chunks_of(data)
        at = dice.randrange(len(chunks))
        kind, content = chunks[at]
        chunks[at] = (
            dice.choice([kind, b"fdAT", b"fcTL", b"tRNS", b"PLTE"]),
            content[: dice.randrange(len(content) + 1)],
        )
        return png_of_chunks(chunks)
    broken = bytearray(data)
    for _ in range(dice.choice([1, 1, 2, 8])):
        at = dice.randrange(len(broken))
        how = dice.randrange(4)
        if how == 0:
            broken[at] ^= 1 << dice.randrange(8)
        elif how == 1:
            broken[at] = dice.choice([0, 127, 128, 255])
        elif how == 2:
            del broken[at : at + dice.randrange(1, 5)]
        else:
            del broken[at + 1 :]
        broken = broken or bytearray(b"\0")
    return bytes(broken)


@pytest.mark.parametrize("name", decoders())
def test_no_damage_raises_anything_else(name: str) -> None:
    decoder, dice = decoders()[name], random.Random(name)
    for valid in decoder.valid:
        decoder.decode(memoryview(valid))
        for _ in range(300 // len(decoder.valid)):
            with suppress(NerfbakeError):
                decoder.decode(memoryview(damaged(valid, dice)))


def test_a_png_with_a_frame_that_it_does_not_declare() -> None:
    """Pillow 13.0 raises AssertionError."""
    chunks = chunks_of(picture_as("PNG"))
    chunks.insert(-1, (b"fdAT", bytes(8)))
    photographs(memoryview(png_of_chunks(chunks)))


@pytest.mark.parametrize("error", picture._BROKEN)
def test_every_error_of_pillow_is_one_line(error: type[Exception], monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*arguments: object, **options: object) -> None:
        raise error("some error")

    monkeypatch.setattr("PIL.Image.open", fail)
    with pytest.raises(NerfbakeError, match="the picture cannot be read"):
        picture.decode_photograph(memoryview(picture_as("PNG")))
