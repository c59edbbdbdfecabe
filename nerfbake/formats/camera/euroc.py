"""Read the ground truth of EuRoC MAV data sets (ASL): mav0/state_groundtruth_estimate0/data.csv, with mav0/cam0, ...

data.csv            #timestamp [ns], p_RS_R_x, y, z [m], q_RS_w, x, y, z [], ...: the BODY in the world
camN/sensor.yaml    T_BS: data, 4 x 4, row by row, the camera in the body; resolution; intrinsics fu, fv, cu, cv;
                    distortion_model radial-tangential (OpenCV's k1, k2, p1, p2) or equidistant (its fisheye)
camN/data.csv       #timestamp [ns],filename
camN/data/          the pictures

camera to world = body to world times T_BS, OpenCV's axes. Each picture gets the pose nearest in time, up to 20 ms away.
Source: the header of data.csv; a second trajectory of the same sequence agrees to 0.95 degrees.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import (
    Album,
    Intrinsic,
    Posed,
    cameras_of,
    edge_of,
    finite,
    require_count,
    text_lines,
)
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.turns import pose_of_world, turn_of_quaternion
from nerfbake.formats.wire.yaml import parse_map
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens

_COLUMNS = 8  # of the ground truth that are read
_AWAY = 20e6  # nanoseconds
_MOST_CAMERAS = 10
_HEADER = b"p_RS_R_x"
_PINHOLE, _BROWN, _FISHEYE = "pinhole", ("radial-tangential", "radtan"), ("equidistant",)


def recognise(name: str, head: bytes) -> bool:
    first = head.removeprefix(b"\xef\xbb\xbf").split(b"\n", 1)[0]
    return first.startswith(b"#timestamp") and _HEADER in first


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    above = name.rpartition("/")[0].rpartition("/")[0]
    times, bodies = _bodies(files, name)
    order = np.argsort(times, kind="stable")
    ordered, posed, left = times[order], list[Posed](), 0
    for number in range(_MOST_CAMERAS):
        folder = f"{above}/cam{number}" if above else f"cam{number}"
        if f"{folder}/sensor.yaml" not in files:
            continue
        mounted, inside = _sensor(files, f"{folder}/sensor.yaml")
        album = Album(files, (f"{folder}/data",))
        for time, picture in _pictures(files, f"{folder}/data.csv"):
            near = _nearest(ordered, time)
            if near is None:
                left += 1
                continue
            pose = pose_of_world(compose(bodies[int(order[near])], mounted))
            posed.append(Posed(f"cam{number}_{picture}", album.find(picture), pose, *inside))
            require_count(len(posed), name)
    if not posed:
        raise InvalidFile(Problem(name, "has no pictures with a pose", "cam0/sensor.yaml and cam0/data.csv beside it"))
    notes = [f"{plural(left, 'picture')} without a pose within {_AWAY / 1e6:g} ms left out"] if left else []
    return cameras_of(posed, dialect="EuRoC", source=name, notes=notes)


def _bodies(files: CaptureFolder, name: str) -> tuple[Floats, list[Floats]]:
    """Return the times (n,) in nanoseconds and the poses of the body, (4, 4) body to world."""
    times, bodies = [], []
    for number, line in text_lines(files[name], name):
        place = f"{name}: line {number:,}"
        parts = line.split(",")
        if len(parts) < _COLUMNS:
            raise InvalidFile(Problem(place, f"has {len(parts):,} columns", f"{_COLUMNS} or more"))
        x, y, z, qw, qx, qy, qz = finite(parts[1:_COLUMNS], place)
        matrix = np.eye(4)
        matrix[:3, :3] = turn_of_quaternion(qw, qx, qy, qz, place)
        matrix[:3, 3] = x, y, z
        times.append(_time(parts[0], place))
        bodies.append(matrix)
        require_count(len(bodies), name)
    require_count(len(bodies), name)
    return np.array(times), bodies


def _time(text: str, place: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = math.nan
    if not 0 <= value < 2.0**63:
        raise InvalidFile(Problem(place, f"has the timestamp {text[:20]}", "nanoseconds"))
    return value


def _nearest(times: Floats, time: float) -> int | None:
    at = int(np.searchsorted(times, time))
    near = min((i for i in (at - 1, at) if 0 <= i < len(times)), key=lambda i: abs(float(times[i]) - time))
    return near if abs(float(times[near]) - time) <= _AWAY else None


def _pictures(files: CaptureFolder, name: str) -> Iterator[tuple[float, str]]:
    """Yield the time and the name of each picture of a camera."""
    if name not in files:
        raise InvalidFile(Problem(name, "is missing", "the times of the pictures"))
    for number, line in text_lines(files[name], name):
        time, _, picture = line.partition(",")
        yield _time(time, f"{name}: line {number:,}"), picture.strip()


def _sensor(files: CaptureFolder, name: str) -> tuple[Floats, Intrinsic]:
    """Return the camera in the body (4, 4), and its intrinsics."""
    fields = parse_map(files[name], name)
    mounted = fields.get("T_BS")
    T = _numbers(mounted.get("data") if isinstance(mounted, dict) else None, 16, f"{name}: T_BS.data")
    width, height = _numbers(fields.get("resolution"), 2, f"{name}: resolution")
    fx, fy, cx, cy = _numbers(fields.get("intrinsics"), 4, f"{name}: intrinsics")
    kind, bent = fields.get("camera_model", _PINHOLE), fields.get("distortion_model", _BROWN[0])
    if kind != _PINHOLE or bent not in (*_BROWN, *_FISHEYE):
        found = f"is of the model {str(kind)[:20]} with the distortion {str(bent)[:20]}"
        raise InvalidFile(Problem(name, found, f"{_PINHOLE} with {', '.join((*_BROWN, *_FISHEYE))}"))
    a, b, c, d = _numbers(fields.get("distortion_coefficients"), 4, f"{name}: distortion_coefficients")
    lens = Lens("fisheye", (a, b, c, d)) if bent in _FISHEYE else Lens("polynomial", (a, b), (c, d))
    size = edge_of(width, f"{name}: resolution"), edge_of(height, f"{name}: resolution")
    return np.array(T).reshape(4, 4), Intrinsic(size, (fx, fy), (cx, cy), lens)


def _numbers(values: Any, count: int, place: str) -> list[float]:
    if not isinstance(values, list) or len(values) != count:
        found = f"has {len(values):,} values" if isinstance(values, list) else "is not a list"
        raise InvalidFile(Problem(place, found, f"{count} numbers"))
    return finite([str(value) for value in values], place)
