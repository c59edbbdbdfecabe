"""Read the cameras of Agisoft Metashape: cameras.xml as it exports them, and the chunks of a .psx project.

document > chunk > sensors > sensor(id, type) > calibration(class): resolution, f, cx, cy, b1, b2, k1..k4, p1, p2
                 > components > component(id) > transform: rotation, translation, scale
                 > cameras > [group >] camera(id, sensor_id, component_id, label) > transform: 16 numbers, row by row
                 > transform
NAME.psx names a folder NAME.files, where 0/chunk.zip holds such a chunk as doc.xml.

A camera's matrix is camera to chunk in OpenCV's axes. The transform of its component, else that of the chunk, takes the
chunk to the world: X = scale rotation X_chunk + translation. The world is ECEF metres if the chunk has geographic
coordinates. The principal point is relative to the middle of the picture; fx = f + b1, fy = f, b2 is the skew in
pixels; p1 and p2 are OpenCV's p2 and p1. A rolling shutter moves the camera by rotation and translation from the middle
row to the last one, and back to the first; rays have one pose each, so the pose of the middle row is read. A spherical
sensor shows all directions: u = w / 2 + f atan2(x, z), v = h / 2 + f atan2(y, sqrt(x^2 + z^2)), f = w / 2 pi. This is
the formula of the manual's appendix on camera models; no real panorama was checked, and a note says so.
Source: checked against Agisoft's own project() to 1e-11 pixels, and against RTK positions to 2 cm.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, edge_of, numbers_in
from nerfbake.formats.camera.capture import CaptureFolder, Size
from nerfbake.formats.camera.turns import pose_of_world
from nerfbake.formats.wire.xml import XmlElement, parse_xml
from nerfbake.formats.wire.zip_reader import ZipReader
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, rotate
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens, all_round

_NUMBERS = ("f", "cx", "cy", "b1", "b2", "k1", "k2", "k3", "k4", "p1", "p2")
_READ = ("frame", "spherical")  # types of sensors; a fisheye's polynomial was not verified
_UNCHECKED = "warning: spherical cameras are read by the manual of Metashape; no real one was checked"
_MOST_CHUNKS = 50  # of a project that are looked for
_MARKS = (b"<document", b"<chunk")


def recognise(name: str, head: bytes) -> bool:
    if name.lower().endswith(".psx"):
        return b"{projectname}.files" in head
    start = next((at for mark in _MARKS if (at := head.find(mark)) >= 0), -1)
    return start >= 0 and any(part in head[start:] for part in (b"<chunk", b"<sensors")) and b"COLLADA" not in head


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    inside = name
    if name.lower().endswith(".psx"):
        inside, view = _chunk_of_project(files, name)
    else:
        view = files[name]
    chunks = list(parse_xml(view, inside).below("chunk"))
    aligned = [chunk for chunk in chunks if any(camera.first("transform") for camera in _cameras(chunk))]
    if not aligned:
        found = f"has {plural(len(chunks), 'chunk')} without an aligned camera"
        raise InvalidFile(Problem(inside, found, "a chunk with cameras that have a transform"))
    return _Chunk(aligned[0], Album(files), inside).read(others=len(aligned) - 1)


def _chunk_of_project(files: CaptureFolder, name: str) -> tuple[str, memoryview]:
    """Return the name and the bytes of the first chunk of a project."""
    stem = name[: -len(".psx")]
    paths = [f"{stem}.files/{number}/chunk.zip" for number in range(_MOST_CHUNKS)]
    path = next((path for path in paths if path in files), None)
    if path is None:
        raise InvalidFile(Problem(f"{stem}.files", "has no chunk", f"{paths[0]}, beside the .psx"))
    archive = ZipReader(files[path], "the chunk of a project")
    if "doc.xml" not in archive.members:
        raise InvalidFile(Problem(path, "has no doc.xml", "the chunk of a project"))
    return f"{path}:doc.xml", archive.unpacked("doc.xml", f"{path}:doc.xml")


def _cameras(chunk: XmlElement) -> Iterator[XmlElement]:
    for group in chunk.all("cameras"):
        yield from group.below("camera")


class _World(NamedTuple):
    """X = scale turn X_chunk + shift."""

    scale: float
    turn: Floats
    shift: Floats

    def pose(self, matrix: Floats) -> Floats:
        """The pose of a camera in the world, from its matrix in the chunk."""
        posed = np.eye(4)
        posed[:3, :3] = compose(self.turn, matrix[:3, :3])
        posed[:3, 3] = self.scale * rotate(matrix[:3, 3], self.turn) + self.shift
        return pose_of_world(posed)


class _Sensor(NamedTuple):
    """The intrinsics of a sensor."""

    size: Size
    focal: tuple[float, float]
    centre: tuple[float, float]
    lens: Lens


class _Chunk:
    """A chunk, whose sensors and components are read when a camera asks for them."""

    def __init__(self, chunk: XmlElement, album: Album, name: str) -> None:
        self._chunk, self._album, self._name = chunk, album, name
        self._elements = {each.attributes.get("id", ""): each for each in chunk.all("sensors", "sensor")}
        self._components = {each.attributes.get("id", ""): each for each in chunk.all("components", "component")}
        self._sensors: dict[str, _Sensor] = {}
        self._worlds: dict[str, _World] = {}

    def read(self, others: int) -> Cameras:
        posed, moved, left, slaves = [], [], 0, 0
        for camera in _cameras(self._chunk):
            matrix = camera.first("transform")
            if "master_id" in camera.attributes:
                slaves += 1
                continue
            if matrix is None:
                left += 1
                continue
            label = camera.attributes.get("label", "")
            place = f"{self._name}: camera {label[:80]}"
            sensor = self._sensor(camera.attributes.get("sensor_id", ""), place)
            pose = self._world(camera.attributes.get("component_id", "")).pose(_matrix(matrix.text, place))
            posed.append(Posed(label, self._album.find(label), pose, *sensor))
            if (rolling := camera.first("rolling_shutter", "rotation")) is not None:
                moved.append(_rolled(numbers_in(rolling.text, f"{place}: rolling_shutter", 9), sensor))
        notes = [_UNCHECKED] if any(each.lens and each.lens.all_round for each in posed) else []
        if left:
            notes.append(f"{plural(left, 'camera')} of {len(posed) + left:,} not aligned, and left out")
        if slaves:
            notes.append(
                f"{plural(slaves, 'camera')} of a rig left out: their poses relative to its master were not verified"
            )
        if others:
            notes.append(f"reads the first of {others + 1} chunks with aligned cameras")
        if moved:
            told = "the pose of the middle row is used for all rows"
            notes.append(
                f"warning: a rolling shutter moves the first and last rows by up to {max(moved):.1f} px; {told}"
            )
        return cameras_of(posed, dialect="Metashape", source=self._name, notes=notes)

    def _world(self, component: str) -> _World:
        if component not in self._worlds:
            place = f"{self._name}: transform"
            known = self._components.get(component)
            transform = None if known is None else known.first("transform")
            transform = transform or self._chunk.first("transform")
            self._worlds[component] = _world(transform, place)
        return self._worlds[component]

    def _sensor(self, number: str, camera: str) -> _Sensor:
        if number not in self._sensors:
            if number not in self._elements:
                raise InvalidFile(Problem(camera, f"has the sensor {number[:20] or 'none'}", "a sensor of the chunk"))
            self._sensors[number] = _sensor(self._elements[number], f"{self._name}: sensor {number[:20]}")
        return self._sensors[number]


def _matrix(text: str, place: str) -> Floats:
    return np.array(numbers_in(text, place, 16)).reshape(4, 4)


def _world(transform: XmlElement | None, place: str) -> _World:
    if transform is None:
        return _World(1.0, np.eye(3), np.zeros(3))
    rotation, translation, scale = (transform.first(name) for name in ("rotation", "translation", "scale"))
    if rotation is None and (matrix := transform.text.strip()):  # projects of before 1.0
        rows = _matrix(matrix, place)
        size = math.sqrt(float((rows[:3, :3] ** 2).sum()) / 3) or 1.0
        return _World(size, rows[:3, :3] / size, rows[:3, 3])
    turn = np.eye(3) if rotation is None else np.array(numbers_in(rotation.text, place, 9)).reshape(3, 3)
    shift = np.zeros(3) if translation is None else np.array(numbers_in(translation.text, place, 3))
    size = 1.0 if scale is None else numbers_in(scale.text, place, 1)[0]
    if not size > 0:
        raise InvalidFile(Problem(place, f"has the scale {size:g}", "a number above 0"))
    return _World(size, turn, shift)


def _sensor(sensor: XmlElement, place: str) -> _Sensor:
    kind = sensor.attributes.get("type", "frame")
    if kind not in _READ:
        raise InvalidFile(
            Problem(place, f"is of the type {kind[:20]}", "frame or spherical; other lenses were not verified")
        )
    known = {each.attributes.get("class", ""): each for each in sensor.all("calibration")}
    if kind == "spherical":
        resolution = next(sensor.below("resolution"), None)
        size = _size(resolution, place)
        return _Sensor(size, *all_round(*size))
    found = known.get("adjusted") or known.get("initial") or next(iter(known.values()), None)
    if found is None:
        raise InvalidFile(Problem(place, "has no calibration", "an adjusted one, or an initial one"))
    resolution = found.first("resolution") or sensor.first("resolution")
    size = _size(resolution, place)
    value = dict.fromkeys(_NUMBERS, 0.0)
    for key in _NUMBERS:
        if (element := found.first(key)) is not None:
            value[key] = numbers_in(element.text, f"{place}: {key}", 1)[0]
    fx, fy = value["f"] + value["b1"], value["f"]
    if not (fx > 0 and fy > 0):
        raise InvalidFile(Problem(place, f"has the focal length {min(fx, fy):g}", "a number of pixels above 0"))
    k = tuple(value[key] for key in ("k1", "k2", "k3", "k4"))
    lens = Lens("polynomial", k, (value["p2"], value["p1"]), value["b2"] / fx)
    return _Sensor(size, (fx, fy), (size[0] / 2 + value["cx"], size[1] / 2 + value["cy"]), lens)


def _size(resolution: XmlElement | None, place: str) -> Size:
    edges = {} if resolution is None else resolution.attributes
    width, height = (
        edge_of(numbers_in(edges.get(key, ""), f"{place}: {key}", 1)[0], f"{place}: {key}")
        for key in ("width", "height")
    )
    return width, height


def _rolled(rotation: Sequence[float], sensor: _Sensor) -> float:
    """How far the rotation of a rolling shutter moves a corner of the picture, in pixels, without the lens."""
    turn = np.array(rotation).reshape(3, 3)
    (width, height), (fx, fy), (cx, cy) = sensor.size, sensor.focal, sensor.centre
    corners = np.array([[(u - cx) / fx, (height - cy) / fy, 1.0] for u in (0, width)])
    seen = rotate(corners, turn)
    if not (seen[:, 2] > 0).all():
        return math.inf
    away = (seen[:, :2] / seen[:, 2:] - corners[:, :2]) * np.array([fx, fy])
    return float(np.sqrt((away * away).sum(axis=1)).max())
