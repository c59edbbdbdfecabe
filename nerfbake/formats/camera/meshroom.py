"""Read the cameras of Meshroom (AliceVision): cameras.sfm, or another .sfm or .json of it. Alembic (.abc) is not read.

version      three numbers; what the fields mean depends on it
views        [{viewId, poseId, intrinsicId, path, width, height}]
poses        [{poseId, pose: {transform: {rotation: [9], center: [3]}}}]
intrinsics   [{intrinsicId, width, height, type or distortionType, distortionParams, principalPoint, ...}]
structure    [{landmarkId, X: [3], observations: [{observationId, x: [2]}]}]

Numbers are texts. rotation is world to camera COLUMN by column, OpenCV's axes. Before 1.2.1 the principal point counts
from the corner, later from the middle. Before 1.2.2 the focal length is pxFocalLength in pixels, later focalLength in
millimetres of a sensor that is sensorWidth wide. pixelRatio is fx/fy before 1.2.5, and fy/fx later.
Source: AliceVision's reader; checked on pictures for 1.0.0 and 1.2.6, both with a pixelRatio of 1.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Intrinsic, Posed, cameras_of, edge_of, finite
from nerfbake.formats.camera.capture import MAX_FRAMES, CaptureFolder
from nerfbake.formats.camera.turns import pose_at
from nerfbake.formats.wire.json import kind_of, parse_object, shorten
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens, LensModel
from nerfbake.scene.sparse_points import SparsePoints


class _Distortion(NamedTuple):
    model: LensModel
    k: int  # number of radial coefficients
    p: bool = False  # whether two tangential ones follow


_DISTORTIONS = {
    "none": _Distortion("polynomial", 0),
    "pinhole": _Distortion("polynomial", 0),
    "radial1": _Distortion("polynomial", 1),
    "radialk1": _Distortion("polynomial", 1),
    "radial3": _Distortion("polynomial", 3),
    "radialk3": _Distortion("polynomial", 3),
    "brown": _Distortion("polynomial", 3, p=True),
    "fisheye4": _Distortion("fisheye", 4),
}


def recognise(name: str, head: bytes) -> bool:
    keys = (b'"viewId"', b'"intrinsicId"', b'"poseId"')
    start = head.lstrip().startswith(b"{") and b'"version"' in head
    return start and (any(key in head for key in keys) or (b'"featuresFolders"' in head and b'"views"' in head))


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    fields = parse_object(files[name], name)
    version = _version(fields.get("version"), name)
    inside = {
        str(each.get("intrinsicId")): _intrinsic(each, version, f"{name}: intrinsics[{i}]")
        for i, each in enumerate(_objects(fields, "intrinsics", name))
    }
    poses = {str(each.get("poseId")): each for each in _objects(fields, "poses", name)}
    views = _objects(fields, "views", name)
    album = Album(files)
    posed: list[Posed] = []
    numbers: dict[str, int] = {}
    for i, view in enumerate(views):
        place = f"{name}: views[{i}]"
        pose, key = poses.get(str(view.get("poseId"))), str(view.get("intrinsicId"))
        if pose is None or key not in inside:
            continue
        label = str(view.get("path", ""))
        numbers[str(view.get("viewId"))] = len(posed)
        posed.append(Posed(label, album.find(label), _pose(pose, place), *inside[key]))
    if not posed:
        raise InvalidFile(
            Problem(name, f"has {plural(len(views), 'view')} without a pose", "the file after StructureFromMotion")
        )
    left = len(views) - len(posed)
    notes = [f"{plural(left, 'view')} of {len(views):,} without a pose left out"] if left else []
    points = _points(fields, numbers, name)
    return cameras_of(posed, dialect="Meshroom", source=name, notes=notes, points=points)


def _objects(fields: Mapping[str, Any], key: str, name: str) -> list[dict[str, Any]]:
    """Return a list of objects; empty if it is missing."""
    value = fields.get(key, [])
    if not isinstance(value, list) or (key != "structure" and len(value) > MAX_FRAMES):
        found = f"has {len(value):,} entries" if isinstance(value, list) else f"is {kind_of(value)}"
        raise InvalidFile(Problem(f"{name}: {key}", found, f"a list of up to {MAX_FRAMES:,} objects"))
    if (wrong := next((each for each in value if not isinstance(each, dict)), value)) is not value:
        raise InvalidFile(Problem(f"{name}: {key}", f"holds {kind_of(wrong)}", "objects"))
    return value


def _version(value: Any, name: str) -> tuple[int, ...]:
    parts = _numbers(value, f"{name}: version", 3)
    return tuple(int(part) for part in parts)


def _numbers(value: Any, place: str, count: int | None = None) -> list[float]:
    """Return a list of numbers that may be written as text."""
    value = list(value.values()) if isinstance(value, dict) else [] if value == "" else value
    if not isinstance(value, list) or (count is not None and len(value) != count):
        found = f"has {len(value):,} entries" if isinstance(value, list) else f"is {kind_of(value)}"
        raise InvalidFile(Problem(place, found, f"{count or 'a list of'} numbers"))
    if (wrong := next((each for each in value if type(each) not in (str, int, float)), value)) is not value:
        raise InvalidFile(Problem(place, f"holds {kind_of(wrong)}", "numbers"))
    return finite([str(each) for each in value], place)


def _number(fields: Mapping[str, Any], key: str, place: str, default: float | None = None) -> float:
    value = fields.get(key, default)
    if type(value) not in (str, int, float):
        found = "is missing" if value is None else f"is {kind_of(value)}"
        raise InvalidFile(Problem(f"{place}.{key}", found, "a number"))
    return finite([str(value)], f"{place}.{key}")[0]


def _intrinsic(fields: Mapping[str, Any], version: Sequence[int], place: str) -> Intrinsic:
    size = tuple(edge_of(_number(fields, key, place), f"{place}.{key}") for key in ("width", "height"))
    width, height = size
    kind = fields.get("distortionType", fields.get("type", "pinhole"))
    if not isinstance(kind, str) or kind.lower() not in _DISTORTIONS:
        raise InvalidFile(Problem(f"{place}: the lens", f"is {shorten(kind)}", ", ".join(_DISTORTIONS)))
    if fields.get("type") == "equidistant" or any(_numbers(fields.get("undistortionOffset", []), place)):
        raise InvalidFile(
            Problem(place, "is equidistant or has an undistortionOffset", "neither, they were not verified")
        )
    ratio = _number(fields, "pixelRatio", place, 1.0) or 1.0
    ratio = ratio if list(version) >= [1, 2, 5] else 1 / ratio
    if list(version) < [1, 2, 0]:
        fx = fy = _number(fields, "pxFocalLength", place)
    elif list(version) < [1, 2, 2]:
        given = fields.get("pxFocalLength")
        fx, fy = _numbers(given if isinstance(given, list) else [given, given], f"{place}.pxFocalLength", 2)
    else:
        sensor = _number(fields, "sensorWidth", place)
        if not sensor > 0:
            raise InvalidFile(Problem(f"{place}.sensorWidth", f"is {sensor:g}", "a number of millimetres above 0"))
        fx = _number(fields, "focalLength", place) / sensor * width
        fy = fx * ratio
    x, y = _numbers(fields.get("principalPoint"), f"{place}.principalPoint", 2)
    if list(version) >= [1, 2, 1]:
        x, y = width / 2 + x, height / 2 + y
    distortion = _DISTORTIONS[kind.lower()]
    values = _numbers(fields.get("distortionParams", []), f"{place}.distortionParams")
    need = distortion.k + 2 * distortion.p
    if len(values) not in ({need} if need else range(7)):
        raise InvalidFile(Problem(f"{place}.distortionParams", f"are {len(values)}", f"{need} for {kind}"))
    p = (values[distortion.k], values[distortion.k + 1]) if distortion.p else (0.0, 0.0)
    return Intrinsic((width, height), (fx, fy), (x, y), Lens(distortion.model, tuple(values[: distortion.k]), p))


def _pose(fields: Mapping[str, Any], place: str) -> Any:
    pose = fields.get("pose")
    transform = pose.get("transform") if isinstance(pose, dict) else None
    if not isinstance(transform, dict):
        raise InvalidFile(Problem(f"{place}: its pose", f"is {kind_of(transform)}", "an object with a transform"))
    turn = np.array(_numbers(transform.get("rotation"), f"{place}: rotation", 9)).reshape(3, 3).T
    return pose_at(turn, _numbers(transform.get("center"), f"{place}: center", 3))


def _points(fields: Mapping[str, Any], numbers: Mapping[str, int], name: str) -> SparsePoints | None:
    landmarks = _objects(fields, "structure", name)
    if not landmarks:
        return None
    place = f"{name}: structure"
    positions = np.array([_numbers(each.get("X"), place, 3) for each in landmarks])
    camera, point, pixel = [], [], []
    for i, landmark in enumerate(landmarks):
        for seen in _objects(landmark, "observations", place):
            number = numbers.get(str(seen.get("observationId")))
            if number is not None and "x" in seen:
                camera.append(number)
                point.append(i)
                pixel.append(_numbers(seen["x"], place, 2))
    return SparsePoints(
        positions, np.array(camera, np.int64), np.array(point, np.int64), np.array(pixel, np.float64).reshape(-1, 2)
    )
