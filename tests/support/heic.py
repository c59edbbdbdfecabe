"""Photographs as an iPhone stores them. pillow-heif encodes them; nothing of ours does."""

from __future__ import annotations

import io

from PIL import Image as Pillow
from pillow_heif import register_heif_opener

ORIENTATION, EXIF, FOCAL_LENGTH = 0x0112, 0x8769, 0xA405  # FocalLengthIn35mmFilm
MAKER_NOTE = 0x927C
FOCAL = 26


def heic_of(picture: Pillow.Image, *, quality: int = 95, note: bytes = b"") -> bytes:
    """Encode a picture as HEIC, with EXIF data that name an orientation and FOCAL. quality -1: without loss.

    note: what the camera adds about itself to the EXIF data.
    """
    register_heif_opener()
    exif = Pillow.Exif()
    exif[ORIENTATION] = 6
    exif.get_ifd(EXIF)[FOCAL_LENGTH] = FOCAL
    if note:
        exif.get_ifd(EXIF)[MAKER_NOTE] = note
    made = io.BytesIO()
    picture.save(made, "HEIF", quality=quality, exif=exif)
    return made.getvalue()
