"""Read kapture: sensors/sensors.txt, records_camera.txt, trajectories.txt, rigs.txt; pictures in records_data.

sensors.txt           sensor, name, camera, MODEL, width, height, parameters...: COLMAP's models by name
records_camera.txt    time, sensor, picture
trajectories.txt      time, device, qw, qx, qy, qz, tx, ty, tz: world to device, OpenCV's axes, w first
rigs.txt              rig, sensor, qw, qx, qy, qz, tx, ty, tz: rig to sensor; a device may be a rig

Columns are separated by commas. Pixels are counted from the upper left corner.
Source: its manual kapture_format.adoc (version 1.1); 0.35 pixels on 3355 observations. What kapture 1.1.12 imports from
a COLMAP model is equal to that model; from OpenMVG, it copies the principal point, which is half a pixel off then.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, edge_of, finite, require_count, text_lines
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.colmap import LAYOUTS, MODELS, ColmapCamera, intrinsics_of
from nerfbake.formats.camera.turns import pose_shifted, turn_of_quaternion
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, rotate
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras

_SENSORS, _RECORDS, _TRAJECTORIES, _RIGS = "sensors.txt", "records_camera.txt", "trajectories.txt", "rigs.txt"
_PICTURES = "records_data"
_SIZES = dict(MODELS.values())

_Motion = tuple[Floats, Floats]  # R (3, 3) and t (3,)


def recognise(name: str, head: bytes) -> bool:
    return name.rpartition("/")[2] == _SENSORS and b"kapture format" in head[:200]


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    folder = f"{name.rpartition('/')[0]}/".removeprefix("/")
    models = dict(_models(files, name))
    motions = {(row[0], row[1]): motion for row, motion in _motions(files, f"{folder}{_TRAJECTORIES}")}
    rigs: dict[str, list[tuple[str, _Motion]]] = {}
    if f"{folder}{_RIGS}" in files:
        for row, of_rig in _motions(files, f"{folder}{_RIGS}"):
            rigs.setdefault(row[1], []).append((row[0], of_rig))
    album = Album(files, (f"{folder}{_PICTURES}", "images", ""))
    posed, left = [], 0
    for place, row in _rows(files, f"{folder}{_RECORDS}", 3):
        time, sensor, label = row[0], row[1], ", ".join(row[2:])
        if sensor not in models:
            raise InvalidFile(Problem(place, f"was taken by sensor {sensor[:40]}", f"a camera of {_SENSORS}"))
        found = motions.get((time, sensor))
        for rig, of_rig in rigs.get(sensor, []):
            if found is None and (moved := motions.get((time, rig))) is not None:
                found = compose(of_rig[0], moved[0]), rotate(moved[1], of_rig[0]) + of_rig[1]
        if found is None:
            left += 1
            continue
        model = models[sensor]
        focal, centre, lens = intrinsics_of(model)
        pose = pose_shifted(*found)
        posed.append(Posed(label, album.find(label), pose, (model.width, model.height), focal, centre, lens))
        require_count(len(posed), name)
    require_count(len(posed), f"{folder}{_RECORDS}")
    notes = [f"{plural(left, 'picture')} without a pose left out"] if left else []
    return cameras_of(posed, dialect="kapture", source=name, notes=notes)


def _rows(files: CaptureFolder, name: str, least: int) -> Iterator[tuple[str, list[str]]]:
    """Yield the place and the columns of each line."""
    if name not in files:
        raise InvalidFile(Problem(name, "is missing", f"a file beside {_SENSORS}"))
    for number, line in text_lines(files[name], name):
        row = [part.strip() for part in line.split(",")]
        place = f"{name}: line {number:,}"
        if len(row) < least:
            raise InvalidFile(Problem(place, f"has {len(row)} columns", f"{least} or more"))
        yield place, row


def _models(files: CaptureFolder, name: str) -> Iterator[tuple[str, ColmapCamera]]:
    for place, row in _rows(files, name, 3):
        if row[2] != "camera":
            continue
        model, *values = row[3:] or [""]
        if model not in LAYOUTS:
            raise InvalidFile(Problem(place, f"has the model {model[:40]}", ", ".join(LAYOUTS)))
        if len(values) != 2 + _SIZES[model]:
            raise InvalidFile(Problem(place, f"has {len(values)} values", f"{2 + _SIZES[model]} for {model}"))
        width, height, *parameters = finite(values, place)
        yield row[0], ColmapCamera(model, edge_of(width, place), edge_of(height, place), tuple(parameters))


def _motions(files: CaptureFolder, name: str) -> Iterator[tuple[list[str], _Motion]]:
    for place, row in _rows(files, name, 9):
        if not all(row[2:9]):
            continue  # a rotation or a position alone is allowed, and is no pose
        w, x, y, z, *shift = finite(row[2:9], place)
        yield row, (turn_of_quaternion(w, x, y, z, place), np.array(shift))
