"""A known distance between two points: places of photographs, or what photographs show at their pixels."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import PurePosixPath
from typing import NamedTuple

from nerfbake.errors import UsageError
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.world import Frame
from nerfbake.stages.pictures_to_views import resized_to

GRAMMAR = "POINT,POINT=1.2m (m, cm or mm), where POINT is a photograph's NAME, or NAME:X:Y+NAME:X:Y"
_UNITS = {"": 1.0, "m": 1.0, "cm": 0.01, "mm": 0.001}
_DISTANCE = re.compile(r"([0-9]{1,9}(?:\.[0-9]{0,9})?|\.[0-9]{1,9}) ?(m|cm|mm)?")
_NUMBER = r"(-?[0-9]{1,9}(?:\.[0-9]{0,9})?)"
_SHOWN = re.compile(rf"(.+?):{_NUMBER}:{_NUMBER}(?:\+|$)")

SizeOf = Callable[[int], tuple[int, int]]  # width and height of the photograph with this number


class Shown(NamedTuple):
    """What a photograph shows at x, y, in pixels from its upper left corner."""

    name: str
    x: float
    y: float

    def __str__(self) -> str:
        return f"{self.name}:{self.x:g}:{self.y:g}"


class KnownPoint(NamedTuple):
    """The place where a photograph was taken, or, if `shown` is not empty, the point that photographs show."""

    name: str
    shown: tuple[Shown, ...] = ()

    def __str__(self) -> str:
        return "+".join(map(str, self.shown)) or self.name


class KnownDistance(NamedTuple):
    """A distance between two points, in metres."""

    first: KnownPoint
    second: KnownPoint
    metres: float

    def require_shown(self, pictures: Sequence[tuple[str, ...]], size_of: SizeOf) -> None:
        """Raise UsageError unless photographs with these names show both points. Call it before doing any work.

        pictures: for each photograph the names that it is known by, paths of which the last part is enough.
        """
        for point in self[:2]:
            _numbers(point, pictures, size_of)


def parse_distance(text: str) -> KnownDistance:
    """Return the distance that a text describes (GRAMMAR). Raises UsageError."""
    points, _, distance = text.rpartition("=")
    first, comma, second = points.partition(",")
    match = _DISTANCE.fullmatch(distance.strip())
    metres = float(match[1]) * _UNITS[match[2] or ""] if match else 0.0
    if not (first and comma and second):
        raise UsageError(f"`scale` is {text[:60]!r}; allowed: gps, none, or {GRAMMAR}")
    if not 1e-6 <= metres <= 1e9:
        raise UsageError(f"the distance of `scale` is {distance[:40]!r}; allowed: 1e-6 to 1e9 m, with m, cm or mm")
    return KnownDistance(_point(first.strip()), _point(second.strip()), metres)


def _point(text: str) -> KnownPoint:
    shown, end = [], 0
    while match := _SHOWN.match(text, end):
        shown.append(Shown(match[1].strip(), float(match[2]), float(match[3])))
        end = match.end()
    if not shown or end < len(text):
        return KnownPoint(text)
    if len(shown) < 2:
        raise UsageError(f"`scale` has one photograph of {text[:80]!r}; allowed: two or more, NAME:X:Y+NAME:X:Y")
    return KnownPoint("", tuple(shown))


def _numbers(point: KnownPoint, pictures: Sequence[tuple[str, ...]], size_of: SizeOf) -> list[int]:
    """Return the numbers of the photographs of a point. Raises UsageError."""
    if not point.shown:
        return [_number(pictures, point.name)]
    numbers = [_number(pictures, each.name) for each in point.shown]
    if len(set(numbers)) < len(numbers):
        raise UsageError(f"{str(point)[:80]!r} of `scale` has a photograph twice; allowed: two different ones or more")
    for number, each in zip(numbers, point.shown, strict=True):
        width, height = size_of(number)
        if not (0 <= each.x <= width and 0 <= each.y <= height):
            allowed = f"0 to {width} and 0 to {height}"
            raise UsageError(f"{str(each)[:80]!r} of `scale` is outside of the picture; allowed: {allowed}")
    return numbers


def _number(pictures: Sequence[tuple[str, ...]], name: str) -> int:
    """Return the number of the photograph with this name, with or without its folder and its extension."""
    found = {i for i, known in enumerate(pictures) if name in known}
    if not found:
        paths = (PurePosixPath(known[-1]) for known in pictures)
        found = {i for i, path in enumerate(paths) if name in (path.name, path.stem)}
    if len(found) != 1:
        text = f"names {len(found)} cameras" if found else "names no camera"
        raise UsageError(f"{name[:80]!r} of `scale` {text}; allowed: a photograph such as {pictures[0][0]}")
    return found.pop()


def frame_by_distance(cameras: Cameras, distance: KnownDistance, size_of: SizeOf) -> tuple[Frame, str]:
    """Return the world in which two points of cameras have a distance, and what it was found by.

    Raises UsageError, InvalidScene.
    """
    from nerfbake.stages.frames import frame_between
    from nerfbake.stages.triangulation import Sighting, Triangulated, triangulate

    pictures = [tuple(filter(None, (camera.name, camera.picture))) or ("",) for camera in cameras.cameras]
    positions: list[Floats] = []
    names: list[str] = []
    found: list[Triangulated] = []
    for point in distance[:2]:
        numbers = _numbers(point, pictures, size_of)
        if point.shown:
            seen = [
                Sighting(_in_pixels(cameras.cameras[number], *size_of(number)), each.x, each.y)
                for number, each in zip(numbers, point.shown, strict=True)
            ]
            found.append(triangulate(seen))
            positions.append(found[-1].position)
            names.append(str(point))
        else:
            positions.append(cameras.eyes[numbers[0]])
            names.append(cameras.names[numbers[0]])
    told = f"by {distance.metres:g} m between {names[0]} and {names[1]}"
    if found:
        miss, angle = max(each.miss for each in found), min(each.angle for each in found)
        told += f", whose rays miss each other by up to {miss:.2g} px and are {angle:.2g} degrees apart or more"
    first, second = positions
    return frame_between(first, second, distance.metres, " and ".join(names)), told


def _in_pixels(camera: Camera, width: int, height: int) -> Camera:
    """Return a camera with the pixels of its photograph, of which the camera of a fit has means."""
    factor = width // camera.width
    if factor > 1 and (width // factor, height // factor) == (camera.width, camera.height):
        return camera.part(slice(0, camera.width), slice(0, camera.height), finer=factor)
    return resized_to(camera, width, height)
