"""Photographs whose colours are not sRGB, by their ICC profile."""

from __future__ import annotations

import io

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from PIL import Image as Pillow
from pillow_heif import register_heif_opener

from nerfbake.formats.picture.png import decode
from nerfbake.formats.wire.colour_profile import into_srgb
from nerfbake.formats.wire.picture import decode_photograph, decode_texture, encode_preview, encode_thumbnail
from nerfbake.kernels.arrays import Floats
from tests.support.profiles import ADOBE_RGB, DISPLAY_P3, GAMMA, SRGB, SRGB_CURVE, profile_of

COLOURS = np.array([[200, 100, 50], [60, 140, 70], [128, 128, 128], [0, 0, 0], [255, 255, 255]], np.uint8)
P3, ADOBE = profile_of(DISPLAY_P3, SRGB_CURVE), profile_of(ADOBE_RGB, GAMMA)


def file(colours: object, kind: str, profile: bytes | None) -> memoryview:
    """A picture of 8 x 8 pixels of each colour, in a row."""
    register_heif_opener()
    made = io.BytesIO()
    pixels = np.kron(np.asarray(colours, np.uint8)[None], np.ones((8, 8, 1), np.uint8))
    options = {"quality": 100, "subsampling": 0} if kind == "JPEG" else {"quality": -1} if kind == "HEIF" else {}
    Pillow.fromarray(pixels).save(made, kind, icc_profile=profile, **options)
    return memoryview(made.getvalue())


def expected(colorants: object, curve: tuple[float, ...]) -> Floats:
    """COLOURS in sRGB by the formulas, 0 to 255."""
    power, a, b, c, d = curve
    x = COLOURS / 255
    linear = np.where(x >= d, (a * x + b) ** power, c * x) @ np.array(colorants) @ np.linalg.inv(np.array(SRGB))
    linear = np.clip(linear, 0, 1)
    encoded: Floats = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return 255 * encoded


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "HEIF"])
@pytest.mark.parametrize(("profile", "space"), [(P3, (DISPLAY_P3, SRGB_CURVE)), (ADOBE, (ADOBE_RGB, GAMMA))])
def test_a_phones_colours_become_srgb(kind: str, profile: bytes, space: tuple[object, tuple[float, ...]]) -> None:
    found = decode_photograph(file(COLOURS, kind, profile))[4, 4::8]
    assert np.abs(found[:, :3] - expected(*space)).max() <= (1 if kind == "PNG" else 3)
    assert np.abs(found[0, :3].astype(int) - COLOURS[0]).max() >= 10
    assert (found[:, 3] == 255).all()


def test_previews_thumbnails_and_pictures_to_compare_with_have_the_same_colours() -> None:
    view = file(COLOURS, "PNG", P3)
    right = decode_photograph(view)
    assert_array_equal(np.asarray(Pillow.open(io.BytesIO(encode_thumbnail(view, 64)))), right)
    preview = np.asarray(Pillow.open(io.BytesIO(encode_preview(view, 64))))[4, 4::8]
    assert np.abs(preview.astype(int) - right[4, 4::8, :3]).max() <= 6
    assert_array_equal(decode(view).pixels[..., :3], right[..., :3])


def test_alpha_stays_and_textures_keep_their_numbers() -> None:
    colours = np.hstack([COLOURS, [[0], [50], [100], [200], [255]]])
    found = decode_photograph(file(colours, "PNG", P3))[4, 4::8]
    assert_array_equal(found[:, 3], colours[:, 3])
    texture = decode_texture(file(COLOURS, "PNG", P3), "a.png")  # glTF 2.0, 3.8.1: profiles of textures are ignored
    assert_array_equal(texture[4, 4::8], COLOURS)


@pytest.mark.parametrize(
    "profile",
    [
        *(None, b"", b"no profile", P3[:200], P3[:132] + b"\xff" * 60),
        profile_of(SRGB, SRGB_CURVE),
        P3[:16] + b"GRAY" + P3[20:],
    ],
)
def test_without_a_profile_of_other_colours_the_numbers_stay(profile: bytes | None) -> None:
    picture = Pillow.fromarray(np.dstack([COLOURS[None], np.full((1, 5), 255, np.uint8)]))
    before = np.asarray(picture).copy()
    into_srgb(picture, profile)
    assert_array_equal(np.asarray(picture), before)
