"""Read reconstruction.json of OpenSfM, with tracks.csv beside it if it is there.

[{cameras: {id: {projection_type, width, height, focal, k1, k2, ...}},
  shots: {picture: {rotation, translation, camera}}, points: {id: {coordinates}}}, ...]

x_cam = R(rotation) X + translation, rotation by axis and angle, OpenCV's axes. Lengths in a picture are relative to its
longer edge m, and to its middle: u = w/2 + m (c_x + f x'). Pixel centres are at half-integer coordinates. Of several
reconstructions, the one with the most shots is read. The world is metres around reference_lla, z up.

tracks.csv    OPENSFM_TRACKS_VERSION_v1 or _v2, then lines: picture, point, feature, x, y, scale, ... between tabs
Source: OpenSfM's io.py and camera_distortions_functions.h; checked by reprojection of both samples' points.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, edge_of, finite, text_lines, turn_limited
from nerfbake.formats.camera.capture import MAX_FRAMES, CaptureFolder, Size
from nerfbake.formats.camera.turns import pose_shifted, turn_of_axis_angle
from nerfbake.formats.wire.json import kind_of, number, parse, shorten, table
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens, LensModel
from nerfbake.scene.sparse_points import SparsePoints

_TRACKS = "tracks.csv"
_TRACK = 200  # bytes of memory of a line's numbers


class _Projection(NamedTuple):
    """k, p: names of the coefficients; apart: whether there are two focal lengths and a principal point."""

    model: LensModel
    k: tuple[str, ...] = ()
    p: tuple[str, ...] = ()
    apart: bool = False


_PROJECTIONS = {
    "perspective": _Projection("polynomial", ("k1", "k2")),
    "simple_radial": _Projection("polynomial", ("k1",), apart=True),
    "radial": _Projection("polynomial", ("k1", "k2"), apart=True),
    "brown": _Projection("polynomial", ("k1", "k2", "k3"), ("p1", "p2"), apart=True),
    "fisheye": _Projection("fisheye", ("k1", "k2")),
    "fisheye_opencv": _Projection("fisheye", ("k1", "k2", "k3", "k4"), apart=True),
}


class Intrinsics(NamedTuple):
    """A camera in pixels."""

    size: Size
    focal: tuple[float, float]
    centre: tuple[float, float]
    lens: Lens

    def pixel(self, x: float, y: float) -> tuple[float, float]:
        """A place in the picture from normalised coordinates."""
        edge = max(self.size)
        return self.size[0] / 2 + edge * x, self.size[1] / 2 + edge * y


def intrinsics_of(fields: Any, place: str) -> Intrinsics:
    """Return the camera of an object of `cameras`; also of OpenDroneMap's cameras.json."""
    if not isinstance(fields, dict):
        raise InvalidFile(Problem(place, f"is {kind_of(fields)}", "an object"))
    kind = fields.get("projection_type", "perspective")
    if not isinstance(kind, str) or kind not in _PROJECTIONS:
        raise InvalidFile(Problem(f"{place}.projection_type", f"is {shorten(kind)}", ", ".join(_PROJECTIONS)))
    projection = _PROJECTIONS[kind]
    width, height = (edge_of(number(fields, key, place), f"{place}.{key}") for key in ("width", "height"))
    edge = max(width, height)
    if projection.apart:
        fx = number(fields, "focal_x", place, low=0)
        fy = number(fields, "focal_y", place, low=0)
        x, y = number(fields, "c_x", place, default=0), number(fields, "c_y", place, default=0)
    else:
        fx = fy = number(fields, "focal", place, low=0)
        x = y = 0.0
    k = tuple(number(fields, key, place, default=0) for key in projection.k)
    p = [number(fields, key, place, default=0) for key in projection.p] or [0.0, 0.0]
    lens = Lens(projection.model, k, (p[0], p[1]))
    return Intrinsics((width, height), (edge * fx, edge * fy), (width / 2 + edge * x, height / 2 + edge * y), lens)


def recognise(name: str, head: bytes) -> bool:
    return head.lstrip().startswith(b"[") and b'"projection_type"' in head


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    whole = parse(files[name], name)
    found = [each for each in whole if isinstance(each, dict)] if isinstance(whole, list) else []
    if not found:
        raise InvalidFile(Problem(name, f"holds {kind_of(whole)}", "a list of reconstructions"))
    largest = max(found, key=lambda each: len(_object(each, "shots", name)))
    models = _object(largest, "cameras", name)
    shots = _object(largest, "shots", name)
    if len(shots) > MAX_FRAMES:
        raise InvalidFile(Problem(name, f"has {len(shots):,} shots", f"up to {MAX_FRAMES:,}"))
    known = {key: intrinsics_of(value, f"{name}: camera {key[:60]}") for key, value in models.items()}
    album, posed, used = Album(files), [], []
    for label, shot in shots.items():
        place = f"{name}: shot {label[:80]}"
        if not isinstance(shot, dict) or str(shot.get("camera")) not in known:
            raise InvalidFile(Problem(place, "has no camera", "the key of an object in cameras"))
        turn = turn_limited(table(shot.get("rotation"), f"{place}.rotation", (3,)).tolist(), place)
        shift = table(shot.get("translation"), f"{place}.translation", (3,))
        used.append(known[str(shot["camera"])])
        posed.append(Posed(label, album.find(label), pose_shifted(turn_of_axis_angle(*turn), shift), *used[-1]))
    points = _points(files, name, _object(largest, "points", name), dict(zip(shots, used, strict=True)))
    others = len(found) - 1
    notes = [f"reads the largest of {others + 1} reconstructions, with {len(posed)} shots"] if others else []
    return cameras_of(posed, dialect="OpenSfM", source=name, notes=notes, points=points)


def _object(fields: Mapping[str, Any], key: str, name: str) -> dict[str, Any]:
    value = fields.get(key, {})
    if not isinstance(value, dict):
        raise InvalidFile(Problem(f"{name}: {key}", f"is {kind_of(value)}", "an object"))
    return value


def _points(
    files: CaptureFolder, name: str, points: Mapping[str, Any], shots: Mapping[str, Intrinsics]
) -> SparsePoints | None:
    if not points:
        return None
    listed = [each.get("coordinates") if isinstance(each, dict) else None for each in points.values()]
    positions = table(listed, f"{name}: points", (len(points), 3))
    tracks = f"{name.rpartition('/')[0]}/{_TRACKS}".removeprefix("/")
    if tracks not in files:
        return SparsePoints(positions)
    numbers = {key: i for i, key in enumerate(points)}
    cameras = {label: i for i, label in enumerate(shots)}
    camera, point, pixel = [], [], []
    for number_of, line in text_lines(files[tracks], tracks):
        parts = line.split("\t")
        if len(parts) < 5 or parts[0] not in cameras or parts[1] not in numbers:
            continue
        x, y = finite(parts[3:5], f"{tracks}: line {number_of:,}")
        memory.hold(tracks, _TRACK)
        camera.append(cameras[parts[0]])
        point.append(numbers[parts[1]])
        pixel.append(shots[parts[0]].pixel(x, y))
    return SparsePoints(
        positions, np.array(camera, np.int64), np.array(point, np.int64), np.array(pixel, np.float64).reshape(-1, 2)
    )
