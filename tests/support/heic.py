"""Photographs as an iPhone stores them."""

from __future__ import annotations

import io

from PIL import Image as Pillow
from pillow_heif import register_heif_opener

ORIENTATION, EXIF, FOCAL_LENGTH = 0x0112, 0x8769, 0xA405  # FocalLengthIn35mmFilm
FOCAL = 26


def heic_of(picture: Pillow.Image, *, quality: int = 95) -> bytes:
    """Encode a picture as HEIC, with EXIF data that name an orientation and FOCAL. quality -1: without loss."""
    register_heif_opener()
    exif = Pillow.Exif()
    exif[ORIENTATION] = 6
    exif.get_ifd(EXIF)[FOCAL_LENGTH] = FOCAL
    made = io.BytesIO()
    picture.save(made, "HEIF", quality=quality, exif=exif)
    return made.getvalue()
