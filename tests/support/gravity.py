"""Photographs that store which way is up."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from nerfbake.kernels.arrays import Floats
from tests.support.heic import EXIF, MAKER_NOTE
from tests.support.panoramas import GPANO

LENS = 0xA434


def apple_note(acceleration: Floats) -> bytes:
    """An iPhone's MakerNote with one tag before the acceleration, which follows the tags."""
    head = b"Apple iOS\0\0\1MM" + struct.pack(">HHHII", 2, 1, 9, 1, 14)
    fractions = [part for value in acceleration for part in (round(value * 10**6), 10**6)]
    return head + struct.pack(">HHII", 8, 10, 3, len(head) + 12) + struct.pack(">6i", *fractions)


def write_apple(
    path: Path,
    acceleration: Floats,
    *,
    size: tuple[int, int] = (8, 6),
    lens: str = "back camera",
    more: Sequence[Pillow.Image] = (),
) -> Path:
    """The photograph of an iPhone. more: pictures behind it, such as the gain map of its highlights."""
    exif = Pillow.Exif()
    exif.get_ifd(EXIF).update({MAKER_NOTE: apple_note(acceleration), LENS: lens})
    options = {"save_all": True, "append_images": more} if more else {}
    Pillow.new("RGB", size).save(path, "MPO" if more else "JPEG", exif=exif.tobytes(), **options)
    return path


def write_drone(path: Path, pitch: float, roll: float) -> Path:
    angles = f'drone-dji:GimbalPitchDegree="{pitch:+.2f}" drone-dji:GimbalRollDegree="{roll:+.2f}"'
    packet = GPANO.format(f'xmlns:drone-dji="http://www.dji.com/drone-dji/1.0/" {angles}')
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.new("RGB", (8, 6)).save(path, "JPEG", xmp=packet.encode())
    return path


def write_upright(path: Path, pose: Floats, up: Floats) -> Path:
    """The picture of a drone's camera in a world where this direction (3,) points up, to 0.01 degrees."""
    x, y, z = up @ pose[:3, :3]
    return write_drone(path, np.degrees(np.arcsin(-z)), np.degrees(np.arctan2(-x, y)))
