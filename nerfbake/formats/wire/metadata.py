"""What a photograph says of itself beside its pixels: where it was taken, what is up, and whether it shows all around.

Source: EXIF 2.32, tables 4, 7 and 8 and section 4.6.6; see gravity.py and xmp.py for the properties of XMP.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from nerfbake.formats.wire import gravity, xmp

EXIF = 0x8769
_GPS = 0x8825  # its tags are 1 N or S, 2 latitude, 3 E or W, 4 longitude, 5 below the sea, 6 altitude
_MAKER_NOTE, _LENS_MODEL = 0x927C, 0xA434
_MOST_ALTITUDE = 1e5  # metres


class Metadata(NamedTuple):
    """What a photograph says of itself; None and False for what it does not say.

    size       width and height as it is decoded
    place      latitude and longitude in degrees and altitude in metres where it was taken
    up         the direction that points up, x right, y up, z back, by the sensors of its camera
    all_round  whether it shows all directions, and is twice as wide as high
    """

    size: tuple[int, int] | None = None
    place: tuple[float, float, float] | None = None
    up: tuple[float, float, float] | None = None
    all_round: bool = False


def metadata_of(picture: Any) -> Metadata:
    """Return what a picture says that Pillow opened and did not decode yet. What is damaged counts as not said."""
    (width, height), packet = picture.size, picture.info.get("xmp")
    properties = xmp.properties_of(packet) if isinstance(packet, bytes) else {}
    all_round = width == 2 * height and xmp.is_all_round(properties)
    return Metadata((width, height), _place(picture), _up(picture, properties), all_round)


def _place(picture: Any) -> tuple[float, float, float] | None:
    try:
        tags = _tags(picture, _GPS)
        latitude, longitude = (_degrees(tags[number], tags[number - 1]) for number in (2, 4))
        altitude = float(tags[6]) * (-1 if tags.get(5) in (1, b"\x01") else 1)
    except Exception:  # Pillow raises many types for damaged EXIF, which says nothing about the pixels
        return None
    fine = abs(latitude) <= 90 and abs(longitude) <= 180 and abs(altitude) <= _MOST_ALTITUDE
    return (latitude, longitude, altitude) if fine and (latitude or longitude) else None


def _degrees(parts: Any, side: Any) -> float:
    degrees, minutes, seconds = map(float, parts)
    return (-1 if str(side)[:1] in "SW" else 1) * (degrees + minutes / 60 + seconds / 3600)


def _up(picture: Any, properties: dict[str, str]) -> tuple[float, float, float] | None:
    try:
        up = gravity.up_of_angles(properties)
        tags = _tags(picture, EXIF) if up is None else {}
        # A JPEG that was turned upright has the axes of the sensor no more; a selfie's are mirrored.
        odd = picture.format != "HEIF" and picture.width < picture.height
        if up is None and _MAKER_NOTE in tags and not odd and "front" not in str(tags.get(_LENS_MODEL)):
            found = gravity.up_of_apple(tags[_MAKER_NOTE])
            up = found and gravity.turned(found, picture.info.get("original_orientation") or 1)
    except Exception:  # Pillow raises many types for damaged EXIF, which says nothing about the pixels
        return None
    return up if up is not None and all(map(math.isfinite, up)) else None


def _tags(picture: Any, group: int) -> Any:
    """The tags of a group of EXIF data. A PNG counts as having none, because Pillow would decode it for them."""
    return {} if picture.format == "PNG" else picture.getexif().get_ifd(group)
