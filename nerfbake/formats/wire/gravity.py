"""Which way is up in a photograph, by the sensors of its camera: what drones, iPhones and stitchers store.

Directions are in the camera's axes: x right, y up, z back, of the picture as it is stored.

DJI            XMP: GimbalPitchDegree, -90 straight down; GimbalRollDegree, positive if the right side is lower. A
               panorama has them, too: of the gimbal, not of the picture that was stitched
GPano          XMP of a panorama: PosePitchDegrees and PoseRollDegrees, the same
Apple          EXIF MakerNote: "Apple iOS", NUL, two bytes, "MM", and a directory of TIFF tags, of which 8 is the
               acceleration in g: three fractions, along the left, bottom and back of the phone seen from its front

An iPhone at rest is accelerated upwards. Its sensor's picture has the top of the phone at its left edge.
Source: ExifTool 13's tables Apple.pm and DJI.pm; Google's "Photo Sphere XMP metadata".
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping

Up = tuple[float, float, float]
_ANGLES = (("GimbalPitchDegree", "GimbalRollDegree"), ("PosePitchDegrees", "PoseRollDegrees"))
_APPLE, _HEAD, _ENTRY = b"Apple iOS\0", 14, 12  # bytes of the head of a MakerNote and of a tag
_ACCELERATION, _SIGNED_FRACTION = 8, 10
_REST = (0.8, 1.2)  # g: the camera was not moved


def up_of_angles(properties: Mapping[str, str]) -> Up | None:
    """Return the direction by the angles in XMP properties, or None. Raises ValueError for text that is no number."""
    stitched = "ProjectionType" in properties
    for names in _ANGLES[stitched:]:
        if all(name in properties for name in names):
            pitch, roll = (math.radians(float(properties[name])) for name in names)
            flat = math.cos(pitch)
            return -math.sin(roll) * flat, math.cos(roll) * flat, -math.sin(pitch)
    return None


def up_of_apple(note: bytes) -> Up | None:
    """Return the direction in the sensor's picture by a MakerNote, or None. Raises struct.error for a damaged one."""
    if not note.startswith(_APPLE) or note[_HEAD - 2 : _HEAD] != b"MM":
        return None
    (count,) = struct.unpack_from(">H", note, _HEAD)
    for i in range(count):
        tag, kind, number, at = struct.unpack_from(">HHII", note, _HEAD + 2 + _ENTRY * i)
        if (tag, kind, number) == (_ACCELERATION, _SIGNED_FRACTION, 3):
            a, b, c, d, e, f = struct.unpack_from(">6i", note, at)
            if not (b and d and f):
                return None
            left, bottom, back = a / b, c / d, e / f
            size = math.sqrt(left * left + bottom * bottom + back * back)
            # The picture's right is the bottom of the phone, and its top the right of the phone.
            return (bottom / size, -left / size, -back / size) if _REST[0] <= size <= _REST[1] else None
    return None


def turned(up: Up, orientation: int) -> Up | None:
    """Return the direction in a picture that was turned upright as its EXIF orientation says; None if mirrored."""
    x, y, z = up
    return {1: up, 3: (-x, -y, z), 6: (y, -x, z), 8: (-y, x, z)}.get(orientation)
