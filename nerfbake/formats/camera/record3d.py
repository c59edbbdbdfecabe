"""Read captures of Record3D: metadata or metadata.json, with the pictures 0.jpg, 1.jpg, ... in `rgb`.

w, h       pixels of the pictures
K          nine numbers COLUMN by column: fx 0 0, 0 fy 0, cx cy 1
poses      [[qx qy qz qw tx ty tz], ...]: camera to world, OpenGL's axes, w LAST; pose i belongs to picture i

There may be more poses than pictures. initPose is not applied. A .r3d is a zip archive of these files, and has to be
unpacked.
Source: 1.2 pixels on 98 matches of a real capture; with w first 75.
"""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, edge_of, require_count
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.turns import turn_of_quaternion
from nerfbake.formats.wire.json import kind_of, number, parse_object, table
from nerfbake.scene.camera import Cameras

_NAMES = ("metadata", "metadata.json")


def recognise(name: str, head: bytes) -> bool:
    named = name.rpartition("/")[2] in _NAMES and head.lstrip().startswith(b"{")
    return named and any(key in head for key in (b'"K"', b'"poses"', b'"initPose"'))


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    fields = parse_object(files[name], name)
    poses = fields.get("poses")
    if not isinstance(poses, list):
        raise InvalidFile(Problem(f"{name}: poses", f"are {kind_of(poses)}", "a list"))
    require_count(len(poses), name)
    rows = table(poses, f"{name}: poses", (len(poses), 7))
    K = table(fields.get("K"), f"{name}: K", (9,)).reshape(3, 3).T
    width, height = (edge_of(number(fields, key, name), f"{name}: {key}") for key in ("w", "h"))
    focal, centre = (float(K[0, 0]), float(K[1, 1])), (float(K[0, 2]), float(K[1, 2]))
    folder = name.rpartition("/")[0]
    album = Album(files, tuple(f"{folder}/{each}".removeprefix("/") for each in ("rgb", "rgbd")))
    posed = []
    for i, (qx, qy, qz, qw, x, y, z) in enumerate(rows.tolist()):
        pose = np.eye(4)
        pose[:3, :3] = turn_of_quaternion(qw, qx, qy, qz, f"{name}: poses[{i}]")
        pose[:3, 3] = x, y, z
        posed.append(Posed(str(i), album.find(str(i)), pose, (width, height), focal, centre))
    return cameras_of(posed, dialect="Record3D", source=name)
