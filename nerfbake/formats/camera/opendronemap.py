"""Read the cameras of OpenDroneMap: odm_report/shots.geojson, with cameras.json in the folder of the project.

features[].properties: filename, camera, rotation (axis and angle, world to camera, OpenCV's axes), translation: the
CENTRE of the camera in the projected coordinates of the map (easting, northing, height). geometry is longitude and
latitude, which are not needed.
cameras.json          {key: a camera of OpenSfM}; `camera` is this key, with or without "v2 " before it
Source: equal to the reconstruction.json of the same project but for a constant, to 4e-10 m.
"""

from __future__ import annotations

from typing import Any

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, turn_limited
from nerfbake.formats.camera.capture import MAX_FRAMES, CaptureFolder
from nerfbake.formats.camera.opensfm import Intrinsics, intrinsics_of
from nerfbake.formats.camera.turns import pose_at, turn_of_axis_angle
from nerfbake.formats.wire.json import kind_of, parse_object, shorten, table
from nerfbake.scene.camera import Cameras

_CAMERAS = "cameras.json"
_VERSION = "v2 "


def recognise(name: str, head: bytes) -> bool:
    return name.lower().endswith(".geojson") and all(key in head for key in (b'"rotation"', b'"translation"'))


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    features = parse_object(files[name], name).get("features")
    if not isinstance(features, list) or not 1 <= len(features) <= MAX_FRAMES:
        found = f"has {len(features):,} features" if isinstance(features, list) else "has no features"
        raise InvalidFile(Problem(name, found, f"1 to {MAX_FRAMES:,}"))
    models = _models(files, name)
    album, posed = Album(files), []
    for i, feature in enumerate(features):
        place = f"{name}: features[{i}].properties"
        shot = feature.get("properties") if isinstance(feature, dict) else None
        if not isinstance(shot, dict):
            raise InvalidFile(Problem(place, f"is {kind_of(shot)}", "an object"))
        key = str(shot.get("camera", ""))
        inside = models.get(key) or models.get(key.removeprefix(_VERSION)) or models.get(_VERSION + key)
        if inside is None:
            raise InvalidFile(Problem(f"{place}.camera", f"is {shorten(key)}", f"a key of {_CAMERAS}"))
        turn = turn_limited(table(shot.get("rotation"), f"{place}.rotation", (3,)).tolist(), place)
        centre = table(shot.get("translation"), f"{place}.translation", (3,))
        label = str(shot.get("filename", ""))
        posed.append(Posed(label, album.find(label), pose_at(turn_of_axis_angle(*turn), centre), *inside))
    return cameras_of(posed, dialect="OpenDroneMap", source=name)


def _models(files: CaptureFolder, name: str) -> dict[str, Intrinsics]:
    """Return the intrinsics by key, from cameras.json beside the shots or in the folder of the capture."""
    folder = name.rpartition("/")[0]
    path = next((path for path in (f"{folder}/{_CAMERAS}", _CAMERAS) if path in files), None)
    if path is None:
        raise InvalidFile(Problem(name, f"has no {_CAMERAS}", "the project's folder with both"))
    fields: dict[str, Any] = parse_object(files[path], path)
    return {key: intrinsics_of(value, f"{path}: {key[:60]}") for key, value in fields.items()}
