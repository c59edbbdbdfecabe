"""Read the sidecars of RealityCapture and RealityScan: NAME.xmp beside each picture NAME.jpg.

Attributes or elements of xcr: Rotation, 9 numbers, world to camera row by row, OpenCV's axes; Position, the camera's
centre; FocalLength35mm, PrincipalPointU, PrincipalPointV, Skew, AspectRatio, DistortionModel, DistortionCoeficients (so
spelled). The size of the picture is in the picture alone. A sidecar without Rotation holds only what the program was
told before it aligned, so it is no camera.
Source: pairs of an .xmp and a row of the CSV of one project agree to 1e-13.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import FOLDERS, Album, cameras_of, finite, numbers_in
from nerfbake.formats.camera.capture import CaptureFolder, visible_names
from nerfbake.formats.camera.realitycapture import DIALECT, Sidecar, unchecked_note
from nerfbake.formats.camera.turns import pose_at
from nerfbake.formats.wire.xml import XmlElement, parse_xml
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras

_ENDINGS = (".xmp", ".XMP")
_MARK = b"capturingreality.com"
_LENSES = ("perspective", "brown3", "brown4", "brown3t2", "brown4t2")
_COEFFICIENTS = 6


def recognise(name: str, head: bytes) -> bool:
    return _MARK in head


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    folder = name.rpartition("/")[0]
    album = Album(files, tuple(dict.fromkeys((folder, *FOLDERS))))
    shots, left = [], 0
    for each in visible_names(files, folder, _ENDINGS):
        path = f"{folder}/{each}" if folder else each
        if _MARK not in bytes(files[path]):
            continue
        fields = _Fields(path, parse_xml(files[path], path))
        shot = _shot(fields, each[: -len(_ENDINGS[0])], album)
        left += shot is None
        shots += [shot] if shot else []
    if not shots:
        raise InvalidFile(Problem(name, "has no Rotation", "a sidecar that was exported after the alignment"))
    sizes, notes = album.sizes([shot.picture for shot in shots])
    if left:
        notes = (*notes, f"{plural(left, 'sidecar')} without Rotation left out")
    posed = [shot.posed(size) for shot, size in zip(shots, sizes, strict=True)]
    source = f"{folder}/*.xmp" if folder else "*.xmp"
    return cameras_of(posed, dialect=DIALECT, source=source, notes=(*notes, *unchecked_note(shots)))


class _Fields(NamedTuple):
    """The fields of a sidecar, in any element of it."""

    place: str
    root: XmlElement

    def text(self, name: str) -> str | None:
        waiting = [self.root]
        while waiting:
            element = waiting.pop()
            if name in element.attributes:
                return element.attributes[name]
            if element.name == name:
                return element.text
            waiting += element.children
        return None

    def number(self, name: str, default: float | None = None) -> float:
        text = self.text(name)
        if text is None:
            if default is None:
                raise InvalidFile(Problem(f"{self.place}: {name}", "is missing", "a number"))
            return default
        return numbers_in(text, f"{self.place}: {name}", 1)[0]

    def require(self, name: str, allowed: float) -> None:
        if (found := self.number(name, allowed)) != allowed:
            raise InvalidFile(Problem(f"{self.place}: {name}", f"is {found:g}", f"{allowed:g}"))


def _shot(fields: _Fields, label: str, album: Album) -> Sidecar | None:
    turn, centre = fields.text("Rotation"), fields.text("Position")
    if turn is None or centre is None:
        return None
    place = fields.place
    fields.require("Skew", 0)
    fields.require("AspectRatio", 1)
    lens = fields.text("DistortionModel") or "perspective"
    if lens not in _LENSES:
        raise InvalidFile(Problem(f"{place}: DistortionModel", f"is {lens[:40]}", ", ".join(_LENSES)))
    given = (fields.text("DistortionCoeficients") or "").split()
    if len(given) > _COEFFICIENTS:
        raise InvalidFile(Problem(f"{place}: DistortionCoeficients", f"are {len(given):,}", f"up to {_COEFFICIENTS}"))
    values = [*finite(given, f"{place}: DistortionCoeficients"), *[0.0] * (_COEFFICIENTS - len(given))]
    return Sidecar(
        label,
        album.find(label),
        pose_at(np.array(numbers_in(turn, f"{place}: Rotation", 9)).reshape(3, 3), numbers_in(centre, place, 3)),
        fields.number("FocalLength35mm"),
        (fields.number("PrincipalPointU", 0), fields.number("PrincipalPointV", 0)),
        values[:4],
        (values[4], values[5]),
        place,
    )
