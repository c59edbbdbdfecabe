"""Read trajectories of Open3D and of Tanks and Temples, NAME.log: for each pose a line of three integers, then 4 x 4.

Poses are camera to world, OpenCV's axes. There are no intrinsics. The pictures are taken in the order of their names.
Source: agrees with Open3D's JSON of the same scene to 3e-16.
"""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import (
    FOLDERS,
    numbers_in,
    require_count,
    text_lines,
)
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.trajectory import first_rows, is_turn, posed_cameras
from nerfbake.formats.camera.turns import pose_of_world
from nerfbake.scene.camera import Cameras

_DIALECT = "Open3D"
_CLASS = "PinholeCameraTrajectory"
_ROWS = 5  # lines of a pose


def recognise(name: str, head: bytes) -> bool:
    rows = first_rows(head, _ROWS)
    if [len(row) for row in rows] != [3, 4, 4, 4, 4] or any(
        value != int(value) for value in rows[0] if abs(value) < 1e9
    ):
        return False
    return is_turn([value for row in rows[1:4] for value in row[:3]]) and rows[4] == [0, 0, 0, 1]


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    poses, rows = [], list[list[float]]()
    for number_of, line in text_lines(files[name], name):
        expected = 4 if rows else 3
        rows.append(numbers_in(line, f"{name}: line {number_of:,}", expected))
        if len(rows) == _ROWS:
            poses.append(pose_of_world(np.array(rows[1:])))
            require_count(len(poses), name)
            rows = []
    if rows or not poses:
        raise InvalidFile(Problem(name, f"ends after {len(rows)} of {_ROWS} lines of a pose", "whole poses"))
    return posed_cameras(files, poses, None, dialect=_DIALECT, name=name, folders=FOLDERS)
