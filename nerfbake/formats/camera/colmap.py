"""Read COLMAP models: `cameras` with the intrinsics, `images` with the poses, both as .bin or as .txt, and `points3D`.

cameras.bin   u64 count, each: u32 id, i32 model, u64 width, u64 height, f64 parameters (their number: MODELS)
images.bin    u64 count, each: u32 id, f64 qw qx qy qz tx ty tz, u32 camera id, name, NUL, u64 points, 24 bytes a point
cameras.txt   lines: id MODEL width height parameters...
images.txt    two lines each: id qw qx qy qz tx ty tz camera-id name; then x y id of each point, in a line that may be
              empty

The binary files are little-endian. Poses are world to camera in OpenCV's axes. Frames are sorted by name. The upper
left corner of a picture is (0, 0) and the centre of its first pixel is (0.5, 0.5), as in nerfbake. Of several models,
sparse/0, sparse/1, ..., the one with the most images is read: the largest is not always the first.
Source: COLMAP's documentation, "Output format"; its sensor/models.h, version 4.2.1.
"""

from __future__ import annotations

import math
import re
import struct
from codecs import BOM_UTF8
from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import MAX_FRAMES, CaptureFolder, inside_of, names_of, room_for
from nerfbake.formats.camera.colmap_points import (
    PLACE,
    Places,
    decode_binary_points,
    decode_text_points,
    sparse_points,
    text_places,
)
from nerfbake.formats.camera.colmap_writer import text_model
from nerfbake.formats.camera.turns import pose_shifted, turn_of_quaternion
from nerfbake.kernels.soundness import MAX_EDGE, plural
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.lens import Lens, LensModel, all_round

# COLMAP's model number: name, number of parameters.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
    11: ("RAD_TAN_THIN_PRISM_FISHEYE", 16),
    12: ("SIMPLE_DIVISION", 4),
    13: ("DIVISION", 5),
    14: ("SIMPLE_FISHEYE", 3),
    15: ("FISHEYE", 4),
    16: ("EUCM", 6),
    17: ("EQUIRECTANGULAR", 2),
}


class ColmapCamera(NamedTuple):
    """COLMAP's camera: the intrinsics of one or more pictures."""

    name: str
    width: int
    height: int
    parameters: tuple[float, ...]


class ColmapImage(NamedTuple):
    """COLMAP's image: the pose of one picture, world to camera.

    turn: rotation as a quaternion (w, x, y, z); shift: translation; model: id of the ColmapCamera; places: where it
    shows points
    """

    number: int
    turn: tuple[float, ...]
    shift: tuple[float, ...]
    model: int
    name: str
    places: Places


_COUNT = struct.Struct("<Q")
_MODEL = struct.Struct("<IiQQ")
_SHOT = struct.Struct("<I7dI")
_MAX_NAME = 4096


def decode_binary_models(view: memoryview, name: str) -> dict[int, ColmapCamera]:
    """Parse the cameras by id. Ids need not be consecutive."""
    count, at = _count(view, name)
    models = []
    for _ in range(count):
        (camera_id, number, width, height), at = _take(view, at, _MODEL, name)
        if number not in MODELS:
            raise InvalidFile(Problem(f"{name}: camera {camera_id}", f"has model {number}", f"0 to {max(MODELS)}"))
        model, size = MODELS[number]
        parameters, at = _take(view, at, struct.Struct(f"<{size}d"), name)
        models.append((camera_id, ColmapCamera(model, width, height, parameters)))
    return _by_id(models, name)


def decode_binary_shots(view: memoryview, name: str) -> list[ColmapImage]:
    """Parse the images. The places of points remain in `view`."""
    count, at = _count(view, name)
    shots = []
    for _ in range(count):
        (number, *pose, model), at = _take(view, at, _SHOT, name)
        end = bytes(view[at : at + _MAX_NAME]).find(0)
        if end < 0:
            raise InvalidFile(
                Problem(name, f"has a name without NUL at byte {at:,}", f"up to {_MAX_NAME:,} bytes, then NUL")
            )
        picture = bytes(view[at : at + end]).decode(errors="replace")
        (points,), at = _take(view, at + end + 1, _COUNT, name)
        start, at = at, at + PLACE.itemsize * points
        if at > len(view):
            allowed = f"{at:,} or more, according to its counts"
            raise InvalidFile(Problem(name, f"ends after {len(view):,} bytes", allowed))
        places = np.frombuffer(view[start:at], PLACE)
        shots.append(ColmapImage(number, tuple(pose[:4]), tuple(pose[4:]), model, picture, places))
    return shots


def _count(view: memoryview, name: str) -> tuple[int, int]:
    (count,), at = _take(view, 0, _COUNT, name)
    if count > MAX_FRAMES:
        raise InvalidFile(Problem(name, f"counts {count:,}", f"up to {MAX_FRAMES:,}"))
    return count, at


def _take(view: memoryview, at: int, what: struct.Struct, name: str) -> tuple[tuple[Any, ...], int]:
    if at + what.size > len(view):
        found = f"ends after {len(view):,} bytes"
        raise InvalidFile(Problem(name, found, f"{at + what.size:,} or more, according to its counts"))
    return what.unpack_from(view, at), at + what.size


_LINE = re.compile(rb"[^\n]*\n?")
_SIZES = dict(MODELS.values())
_MAX_LINE = 8192  # bytes of a line that is parsed
_POINTS_HEAD = 1024  # bytes of a line of points that are checked: in a line of an image, the name starts before


def decode_text_models(view: memoryview, name: str) -> dict[int, ColmapCamera]:
    """Parse the cameras by id. Ids need not be consecutive."""
    models = []
    for number, line in _lines(view, name):
        camera_id, model, width, height, *parameters = _parts(line, 5, number, name)
        if model not in _SIZES:
            raise InvalidFile(Problem(f"{name}: line {number:,}", f"has model {model[:40]}", ", ".join(_SIZES)))
        if len(parameters) != _SIZES[model]:
            found = f"has {len(parameters)} parameters"
            raise InvalidFile(Problem(f"{name}: line {number:,}", found, f"{_SIZES[model]} for {model}"))
        numbers = _numbers((camera_id, width, height, *parameters), number, name)
        key, *edges = (_whole(value, number, name) for value in numbers[:3])
        models.append((key, ColmapCamera(model, edges[0], edges[1], numbers[3:])))
    return _by_id(models, name)


def decode_text_shots(view: memoryview, name: str, *, points: bool) -> list[ColmapImage]:
    """Parse the images. points: also their lines of points, which are else skipped."""
    shots = []
    lines_of_points: dict[int, memoryview] = {}
    for number, line in _lines(view, name, points=lines_of_points):
        parts = _parts(line, 10, number, name, splits=9)  # a name may have spaces
        numbers = _numbers(parts[:9], number, name)
        key, model = (_whole(value, number, name) for value in (numbers[0], numbers[8]))
        shots.append(ColmapImage(key, numbers[1:5], numbers[5:8], model, parts[9], np.zeros(0, PLACE)))
    if not points:
        return shots
    seen = [*lines_of_points.items(), (0, memoryview(b""))]  # a file may end without its last line
    placed = (text_places(bytes(line), number, name) for number, line in seen)
    return [shot._replace(places=places) for shot, places in zip(shots, placed, strict=False)]


def _lines(view: memoryview, name: str, *, points: dict[int, memoryview] | None = None) -> Iterator[tuple[int, str]]:
    """Yield (line number, text) of all lines that are neither empty nor comments.

    points: a line of points follows each of them; these are added here, by their number, and not yielded.
    """
    view = view[3:] if bytes(view[:3]) == BOM_UTF8 else view
    found, skip = 0, False
    for number, match in enumerate(_LINE.finditer(view), start=1):
        start, end = match.span()
        if skip and points is not None:
            _require_points(view[start:end], number, name)
            points[number] = view[start:end]
            skip = False
            continue
        line = bytes(view[start : min(end, start + _MAX_LINE)]).strip()
        if not line or line.startswith(b"#"):
            continue
        found += 1
        if end - start > _MAX_LINE or found > MAX_FRAMES:
            what = f"has {end - start:,} bytes" if found <= MAX_FRAMES else f"is entry {found:,}"
            raise InvalidFile(Problem(f"{name}: line {number:,}", what, f"{_MAX_LINE:,} bytes, {MAX_FRAMES:,} entries"))
        yield number, line.decode(errors="replace")
        skip = points is not None


def _require_points(line: memoryview, number: int, name: str) -> None:
    """Raise InvalidFile if the start of a line that is skipped is not that of a line of points.

    Some programs write no lines of points; then every second image would be skipped.
    """
    parts = bytes(line[:_POINTS_HEAD]).split()
    complete = len(line) <= _POINTS_HEAD
    try:
        count = len(list(map(float, parts if complete else parts[:-1])))
    except ValueError:
        count = -1
    if count < 0 or (complete and count % 3):
        text = bytes(line[:60]).decode(errors="replace").strip()
        found = f"is not the points of the image above, but {text}"
        raise InvalidFile(Problem(f"{name}: line {number:,}", found, "x y id of each point, or an empty line"))


def _parts(line: str, least: int, number: int, name: str, *, splits: int = -1) -> list[str]:
    """Split a line at its first `splits` spaces, or at all of them (-1). Raises InvalidFile for fewer parts."""
    parts = line.split(maxsplit=splits)
    if len(parts) < least:
        raise InvalidFile(Problem(f"{name}: line {number:,}", f"has {len(parts)} entries", f"{least} or more"))
    return parts


def _numbers(parts: tuple[str, ...] | list[str], number: int, name: str) -> tuple[float, ...]:
    try:
        numbers = tuple(map(float, parts))
    except ValueError:
        numbers = (math.nan,)
    if not all(map(math.isfinite, numbers)):
        raise InvalidFile(Problem(f"{name}: line {number:,}", "holds a value that is not a number", "finite numbers"))
    return numbers


def _whole(value: float, number: int, name: str) -> int:
    if value != int(value):
        raise InvalidFile(Problem(f"{name}: line {number:,}", f"has {value:g}", "a whole number in this place"))
    return int(value)


def _by_id(models: list[tuple[int, ColmapCamera]], name: str) -> dict[int, ColmapCamera]:
    _require_once("camera id", (key for key, _ in models), name)
    return dict(models)


def _require_once(what: str, keys: Iterable[int | str], name: str) -> None:
    for key, times in Counter(keys).most_common(1):
        if times > 1:
            raise InvalidFile(Problem(f"{name}: {what} {key}", f"occurs {times:,} times", "each once"))


# Possible folders of the models, {} for their numbers: COLMAP's, then nerfstudio's and instant-ngp's.
_PLACES = ("", "sparse/{}/", "sparse/", "colmap/sparse/{}/", "colmap_sparse/{}/", "colmap_text/")
_FIRST = tuple(place.format(0) for place in _PLACES)
_MAX_MODELS = 50  # of a capture: COLMAP's default
_PICTURES = "images/"  # relative to the capture's folder, independent of the folder of the model
_KINDS = ("bin", "txt")  # in order of preference, as in COLMAP


class _Layout(NamedTuple):
    """The order of a model's parameters: 1 or 2 focal lengths, cx, cy, then the coefficients of the lens.

    Without a focal length, the parameters are the width and the height of a picture of all directions.
    lens: None for a pinhole; k, p, prism: indices of k1, k2, ..., of p1, p2, and of s1, s3 or of s1, s2, s3, s4
    """

    focals: int
    lens: LensModel | None = None
    k: tuple[int, ...] = ()
    p: tuple[int, int] | None = None
    prism: tuple[int, ...] = ()


LAYOUTS = {
    "SIMPLE_PINHOLE": _Layout(1),
    "PINHOLE": _Layout(2),
    "SIMPLE_RADIAL": _Layout(1, "polynomial", (3,)),
    "RADIAL": _Layout(1, "polynomial", (3, 4)),
    "OPENCV": _Layout(2, "polynomial", (4, 5), (6, 7)),
    "OPENCV_FISHEYE": _Layout(2, "fisheye", (4, 5, 6, 7)),
    "FULL_OPENCV": _Layout(2, "rational", (4, 5, 8, 9, 10, 11), (6, 7)),
    "SIMPLE_RADIAL_FISHEYE": _Layout(1, "fisheye", (3,)),
    "RADIAL_FISHEYE": _Layout(1, "fisheye", (3, 4)),
    "SIMPLE_FISHEYE": _Layout(1, "fisheye"),
    "FISHEYE": _Layout(2, "fisheye"),
    "FOV": _Layout(2, "fov", (4,)),
    "SIMPLE_DIVISION": _Layout(1, "division", (3,)),
    "DIVISION": _Layout(2, "division", (4,)),
    "EUCM": _Layout(2, "eucm", (4, 5)),
    "THIN_PRISM_FISHEYE": _Layout(2, "thin_prism", (4, 5, 8, 9), (6, 7), (10, 11)),
    "RAD_TAN_THIN_PRISM_FISHEYE": _Layout(2, "prisms", (4, 5, 6, 7, 8, 9), (11, 10), (12, 13, 14, 15)),
    "EQUIRECTANGULAR": _Layout(0, "equirectangular"),
}


FILES = re.compile(r"(cameras|images|points3D)\.txt")


def recognise(files: CaptureFolder) -> bool:
    return bool(_found(files))


def encode(cameras: Cameras) -> Iterator[tuple[str, Iterator[bytes]]]:
    """Yield the files of a text model. Pictures are not written."""
    yield from text_model(cameras)


def decode(files: CaptureFolder, *, member: str = "") -> Cameras:
    """Read the model of a folder. member: the file that the user named, if any; its extension selects .bin or .txt."""
    found = [("", member.rpartition(".")[2])] if member else _found(files)
    if not found or not _complete(files, *found[0]):
        raise InvalidFile(Problem("the model", "is incomplete", "cameras and images, both .bin or both .txt"))
    folder, kind = found[0] if len(found) == 1 else max(found, key=lambda each: _count_images(files, *each))
    cameras, images, points = (f"{folder}{name}.{kind}" for name in ("cameras", "images", "points3D"))
    positions = {}
    if points in files:
        positions = (decode_binary_points if kind == "bin" else decode_text_points)(files[points], points)
    if kind == "bin":
        models = decode_binary_models(files[cameras], cameras)
        shots = decode_binary_shots(files[images], images)
    else:
        models = decode_text_models(files[cameras], cameras)
        shots = decode_text_shots(files[images], images, points=bool(positions))
    shots = sorted(shots, key=lambda shot: shot.name)
    room_for(len(shots))
    _require_once("image id", (shot.number for shot in shots), images)
    # Different names that are not UTF-8 may look equal, with U+FFFD for such bytes.
    _require_once("image name", (shot.name for shot in shots if "\ufffd" not in shot.name), images)
    names = names_of(shot.name for shot in shots)
    placed = tuple(_camera(shot, name, models) for shot, name in zip(shots, names, strict=True))
    notes: tuple[str, ...] = ()
    if len(found) > 1 or folder not in _FIRST:
        which = f"the largest of {len(found):,} COLMAP models" if len(found) > 1 else "the only COLMAP model"
        notes = (f"using {folder[:-1]}, {which}, with {plural(len(shots), 'image')}",)
    seen = sparse_points(positions, [shot.places for shot in shots], images)
    return Cameras(placed, "COLMAP", images, notes, points=seen)


def _found(files: CaptureFolder) -> list[tuple[str, str]]:
    """Return the subfolder and the extension of each model in the first of _PLACES that has one, by number."""
    for place in _PLACES:
        folders = dict.fromkeys(place.format(number) for number in range(_MAX_MODELS))
        found = {folder: kind for folder in folders for kind in reversed(_KINDS) if _complete(files, folder, kind)}
        if found:
            return list(found.items())
    return []


def _complete(files: CaptureFolder, folder: str, kind: str) -> bool:
    return f"{folder}cameras.{kind}" in files and f"{folder}images.{kind}" in files


def _count_images(files: CaptureFolder, folder: str, kind: str) -> int:
    """Return the number of registered images of a model."""
    name = f"{folder}images.{kind}"
    if kind == "bin":
        return int.from_bytes(files.head(name, _COUNT.size), "little")
    return sum(1 for _ in _lines(files[name], name, points={}))


def _camera(shot: ColmapImage, name: str, models: dict[int, ColmapCamera]) -> Camera:
    if shot.model not in models:
        raise InvalidFile(Problem(f"image {name}", f"was taken by camera {shot.model}", "a camera of the model"))
    model = models[shot.model]
    if not (model.width <= MAX_EDGE and model.height <= MAX_EDGE):
        found = f"has {model.width:,}x{model.height:,} pixels"
        raise InvalidFile(Problem(f"camera {shot.model}", found, f"up to {MAX_EDGE:,} per edge"))
    picture = inside_of(shot.name)
    picture = picture and f"{_PICTURES}{picture}"
    focal, centre, lens = intrinsics_of(model)
    return Camera(model.width, model.height, focal, _pose(shot, name), name, centre, lens, picture)


def intrinsics_of(model: ColmapCamera) -> tuple[tuple[float, float], tuple[float, float], Lens | None]:
    """Return focal lengths, principal point and lens of a model, from all of its parameters."""
    layout, values = LAYOUTS[model.name], model.parameters
    if not layout.focals:
        return all_round(*values)
    lens = None
    if layout.lens:
        p = (0.0, 0.0) if layout.p is None else (values[layout.p[0]], values[layout.p[1]])
        prism = [values[i] for i in layout.prism]
        if len(prism) == 2:
            prism = [prism[0], 0.0, prism[1], 0.0]
        s1, s2, s3, s4 = prism or (0.0,) * 4
        lens = Lens(layout.lens, tuple(values[i] for i in layout.k), p, prism=(s1, s2, s3, s4))
    cx, cy = values[layout.focals : layout.focals + 2]
    return (values[0], values[layout.focals - 1]), (cx, cy), lens


def _pose(shot: ColmapImage, name: str) -> npt.NDArray[np.float64]:
    """Return the pose, (4, 4) camera to world, in OpenGL's axes."""
    w, x, y, z = shot.turn
    turn = turn_of_quaternion(w, x, y, z, f"image {name}")
    if not all(abs(value) <= MAX_WORLD for value in shot.shift):
        raise InvalidFile(Problem(f"image {name}", f"has the shift {shot.shift}", f"up to {MAX_WORLD:g} world units"))
    return pose_shifted(turn, shot.shift)
