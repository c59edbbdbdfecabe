"""Read trajectories of TUM's RGB-D benchmark: lines of a timestamp, tx ty tz, qx qy qz qw, camera to world.

OpenCV's axes; the quaternion has w LAST. rgb.txt beside it has a line `timestamp picture` for each picture, and each
picture gets the pose nearest in time, up to 20 ms away. Without it the pictures are taken in the order of their names.
The file has no intrinsics.
Source: the optical axes of a real capture meet; with w first they miss each other by 1.3 m of 2.2.
"""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import FOLDERS, Album, finite, numbers_in, require_count, text_lines
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.trajectory import first_rows, posed_cameras
from nerfbake.formats.camera.turns import pose_of_world, turn_of_quaternion
from nerfbake.kernels.arrays import Floats
from nerfbake.scene.camera import Cameras

_PICTURES = "rgb.txt"
_AWAY = 0.02  # seconds


def recognise(name: str, head: bytes) -> bool:
    rows = first_rows(head)
    if not rows or any(len(row) != 8 for row in rows):
        return False
    times = [row[0] for row in rows]
    return times == sorted(times) and all(abs(sum(q * q for q in row[4:]) - 1) < 1e-2 for row in rows)


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    times, poses = [], []
    for number, line in text_lines(files[name], name):
        place = f"{name}: line {number:,}"
        time, x, y, z, qx, qy, qz, qw = numbers_in(line, place, 8)
        matrix = np.eye(4)
        matrix[:3, :3] = turn_of_quaternion(qw, qx, qy, qz, place)
        matrix[:3, 3] = x, y, z
        times.append(time)
        poses.append(pose_of_world(matrix))
        require_count(len(poses), name)
    paths = None
    if _PICTURES in files:
        paths, poses = _associated(files, np.array(times), poses)
    return posed_cameras(files, poses, paths, dialect="TUM", name=name, folders=FOLDERS)


def _associated(files: CaptureFolder, times: Floats, poses: list[Floats]) -> tuple[list[str], list[Floats]]:
    """Return the pictures of rgb.txt that have a pose, and these poses."""
    album, order = Album(files), np.argsort(times, kind="stable")
    ordered = times[order]
    paths, found = [], []
    for number, line in text_lines(files[_PICTURES], _PICTURES):
        parts = line.split(maxsplit=1)
        (time,) = finite(parts[:1], f"{_PICTURES}: line {number:,}")
        if len(parts) < 2 or not len(ordered):
            continue
        at = int(np.searchsorted(ordered, time))
        near = min((i for i in (at - 1, at) if 0 <= i < len(ordered)), key=lambda i: abs(float(ordered[i]) - time))
        if abs(float(ordered[near]) - time) <= _AWAY:
            paths.append(album.find(parts[1]))
            found.append(poses[int(order[near])])
    if not paths:
        raise InvalidFile(Problem(_PICTURES, "names no picture with a pose", f"one within {_AWAY:g} s of a pose"))
    return paths, found
