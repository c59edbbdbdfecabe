"""Shared by the readers of RealityCapture's and RealityScan's files: intrinsics relative to the longer edge.

f is given for a film 36 mm wide, the principal point relative to the middle of the picture, both by the longer edge.
The distortion is k1 k2 k3 (k4 of r^8) t1 t2. RealityScan's export templates name t1 OpenCV's p2 and t2 its p1; that was
not checked on pictures, so a note says it. `division` and other lenses are refused.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Posed
from nerfbake.formats.camera.capture import Size
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.lens import Lens

DIALECT = "RealityCapture"
FILM = 36.0  # mm
_UNCHECKED = "warning: t1 and t2 are read as OpenCV's p2 and p1, which was not checked on pictures"


class Sidecar(NamedTuple):
    """A picture of the capture before its size is known. k: up to four; t: (t1, t2)."""

    label: str
    picture: str
    pose: Floats
    film: float
    centre: tuple[float, float]
    k: Sequence[float]
    t: tuple[float, float]
    place: str

    def posed(self, size: Size) -> Posed:
        edge = max(size)
        focal = self.film / FILM * edge
        if not focal > 0:
            raise InvalidFile(Problem(self.place, f"has the focal length {self.film:g} mm", "a number above 0"))
        centre = size[0] / 2 + self.centre[0] * edge, size[1] / 2 + self.centre[1] * edge
        lens = Lens("polynomial", tuple(self.k), (self.t[1], self.t[0]))
        return Posed(self.label, self.picture, self.pose, size, (focal, focal), centre, lens)


def unchecked_note(shots: Sequence[Sidecar]) -> tuple[str, ...]:
    """The note for tangential distortion."""
    return (_UNCHECKED,) if any(any(shot.t) for shot in shots) else ()
