"""Photographs as an iPhone stores them."""

from __future__ import annotations

from pathlib import Path

from PIL import Image as Pillow
from pillow_heif import register_heif_opener


def write_heic(target: Path, source: Path, *, focal: int = 26) -> None:
    """Write a picture as HEIC, with EXIF data that name a focal length and an orientation."""
    register_heif_opener()
    exif = Pillow.Exif()
    exif[0x0112] = 6
    exif.get_ifd(0x8769)[0xA405] = focal  # FocalLengthIn35mmFilm
    with Pillow.open(source) as picture:
        picture.convert("RGB").save(target, "HEIF", quality=95, exif=exif)
