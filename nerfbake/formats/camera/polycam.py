"""Read raw captures of Polycam: keyframes/corrected_cameras/TIME.json beside keyframes/corrected_images/TIME.jpg.

t_00 ... t_23    row i and column j of camera to world, ARKit's axes (those of OpenGL), metres, y up
fx, fy, cx, cy, width, height    pixels of the picture as the sensor has it; corrected cameras since 2025 have no width
                 and height (nerfstudio's pull request 3725), and then the picture says them

The corrected folders, whose pictures have no distortion, are read if both are there; else cameras and images, whose
distortion is not in the files.
Source: the README of PolyCam/polyform; nerfstudio and simplecv agree with it. No real capture was checked, and a note
says so.
"""

from __future__ import annotations

import numpy as np

from nerfbake.formats.camera.album import Album, Posed, cameras_of, edge_of, require_count
from nerfbake.formats.camera.capture import CaptureFolder, visible_names
from nerfbake.formats.wire.json import number, parse_object
from nerfbake.scene.camera import Cameras

_CORRECTED = ("corrected_cameras", "corrected_images")
_RAW = ("cameras", "images")
_UNCHECKED = "warning: files of Polycam are read by its own description; no real capture was checked"
_DISTORTED = "the pictures are not the corrected ones: their distortion is in no file, and stays"


def recognise(name: str, head: bytes) -> bool:
    return head.lstrip().startswith(b"{") and all(key in head for key in (b'"t_00"', b'"t_23"', b'"fx"'))


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    folder = name.rpartition("/")[0]
    above, _, last = folder.rpartition("/")
    cameras, pictures = ((f"{above}/{each}" if above else each) for each in _CORRECTED)
    corrected = last in (*_CORRECTED, *_RAW) and all(map(bool, (files.names(cameras), files.names(pictures))))
    if not corrected:
        cameras = folder
        pictures = f"{above}/{_RAW[1]}" if above else _RAW[1]
        if last == _CORRECTED[0]:
            pictures = f"{above}/{_CORRECTED[1]}" if above else _CORRECTED[1]
    names = visible_names(files, cameras, ".json")
    require_count(len(names), name)
    album, posed = Album(files, (pictures, folder)), []
    for each in names:
        path = f"{cameras}/{each}" if cameras else each
        fields = parse_object(files[path], path)
        pose = np.eye(4)
        for i in range(3):
            for j in range(4):
                pose[i, j] = number(fields, f"t_{i}{j}", path)
        label = each.removesuffix(".json")
        picture = album.find(label)
        size = None if "width" in fields else album.size(picture)
        if size is None:
            width, height = (edge_of(number(fields, key, path), f"{path}: {key}") for key in ("width", "height"))
            size = width, height
        focal, centre = (tuple(number(fields, key, path) for key in keys) for keys in (("fx", "fy"), ("cx", "cy")))
        posed.append(Posed(label, picture, pose, size, (focal[0], focal[1]), (centre[0], centre[1])))
    raw = cameras.rpartition("/")[2] == _RAW[0]
    source = f"{cameras}/*.json" if cameras else "*.json"
    return cameras_of(posed, dialect="Polycam", source=source, notes=(_UNCHECKED, *((_DISTORTED,) if raw else ())))
