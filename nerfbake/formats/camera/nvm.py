"""Read .nvm of VisualSFM, as COLMAP writes it.

NVM_V3
N, then N lines: name f qw qx qy qz cx cy cz r 0     world to camera, OpenCV's axes; (cx, cy, cz) is the CENTRE
P, then P lines: x y z r g b n, then n times: camera, feature, x, y

The principal point is the middle of the picture, and the file has no sizes: they come from the pictures. r is -k1.
VisualSFM's own manual defines r in the other direction; no file of its own was found, so a note says it where the two
differ. The places of points count from the corner, or from the middle, as the manual and TheiaSfM have it: then three
of four have a number below 0, and a note says so. Only the first model is read.
Source: 0.61 pixels on 36,854 observations of a real file; with the manual's formula 1.13; a file of pytheia 1.2.1.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, finite, numbers_in, require_count, text_lines
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.turns import pose_at, turn_of_quaternion
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens
from nerfbake.scene.sparse_points import SparsePoints

_MARK = "NVM_V3"
_NUMBERS = 10  # of a camera, after its name
_UNCLEAR = 0.05  # a larger r means something else in the manual of VisualSFM
_OUTSIDE = 0.1  # of the places, left of or above the corner: more of them count from the middle
_MAX_LINE = 1 << 20
_POINT = 400  # bytes of memory of a point


def recognise(name: str, head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").startswith(_MARK.encode())


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    lines = text_lines(files[name], name, most=_MAX_LINE)
    _, first = _next(lines, name)
    if first != _MARK:
        raise InvalidFile(
            Problem(name, f"starts with {first[:60]}", f"{_MARK} alone: fixed intrinsics were not verified")
        )
    count = _count(lines, name)
    require_count(count, name)
    album, rows = Album(files), []
    for _ in range(count):
        number, line = _next(lines, name)
        place = f"{name}: line {number:,}"
        label, *parts = line.rsplit(maxsplit=_NUMBERS)
        if len(parts) != _NUMBERS:
            raise InvalidFile(Problem(place, f"has {len(parts) + 1} entries", f"a name and {_NUMBERS} numbers"))
        rows.append((label, album.find(label), finite(parts, place), place))
    sizes, notes = album.sizes([path for _, path, _, _ in rows])
    posed, largest = [], 0.0
    for (label, path, values, place), size in zip(rows, sizes, strict=True):
        f, w, x, y, z, cx, cy, cz, r, _ = values
        largest = max(largest, abs(r))
        pose = pose_at(turn_of_quaternion(w, x, y, z, place), (cx, cy, cz))
        posed.append(Posed(label, path, pose, size, (f, f), None, Lens("polynomial", (-r,))))
    if largest > _UNCLEAR:
        told = "r is read as -k1, as COLMAP writes it; VisualSFM's manual defines it the other way round"
        notes = (*notes, f"the lenses bend by up to r = {largest:.3g}: {told}")
    points = _points(lines, count, name)
    if points is not None and (points.pixel < 0).any(axis=1).sum() > _OUTSIDE * len(points.pixel):
        points = replace(points, pixel=points.pixel + np.array(sizes)[points.camera] / 2)
        notes = (*notes, "places of points below 0: they count from the middle of a picture, as in VisualSFM's manual")
    return cameras_of(posed, dialect="NVM", source=name, notes=notes, points=points)


def _next(lines: Iterator[tuple[int, str]], name: str) -> tuple[int, str]:
    for number, line in lines:
        return number, line
    raise InvalidFile(Problem(name, "ends early", "all cameras and points that it counts"))


def _count(lines: Iterator[tuple[int, str]], name: str) -> int:
    number, line = _next(lines, name)
    (count,) = numbers_in(line, f"{name}: line {number:,}", 1)
    if count != int(count) or count < 0:
        raise InvalidFile(Problem(f"{name}: line {number:,}", f"counts {count:g}", "a whole number"))
    return int(count)


def _points(lines: Iterator[tuple[int, str]], cameras: int, name: str) -> SparsePoints | None:
    try:
        count = _count(lines, name)
    except InvalidFile:
        return None  # a file may end after its cameras
    positions, camera, point, pixel = [], list[int](), list[int](), list[list[float]]()
    for i in range(count):
        number, line = _next(lines, name)
        values = numbers_in(line, f"{name}: line {number:,}")
        if len(values) < 7 or len(values) != 7 + 4 * values[6]:
            raise InvalidFile(
                Problem(f"{name}: line {number:,}", f"has {len(values):,} numbers", "x y z r g b n, then 4 n")
            )
        memory.hold(f"the points of {name}", _POINT * (1 + int(values[6])))
        positions.append(values[:3])
        for at in range(7, len(values), 4):
            if 0 <= values[at] < cameras:
                camera.append(int(values[at]))
                point.append(i)
                pixel.append(values[at + 2 : at + 4])
    if not positions:
        return None
    return SparsePoints(
        np.array(positions), np.array(camera, np.int64), np.array(point, np.int64), np.array(pixel).reshape(-1, 2)
    )
