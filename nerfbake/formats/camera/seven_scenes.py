"""Read poses of 7-Scenes: NAME.pose.txt with 4 x 4 numbers, camera to world, beside NAME.color.png.

OpenCV's axes. intrinsics.txt has to be in the same folder, because the poses have no focal length.
Source: agrees with kapture's own reading of such a file.
"""

from __future__ import annotations

import numpy as np

from nerfbake.formats.camera.album import FOLDERS, Album, numbers_in, require_count
from nerfbake.formats.camera.capture import CaptureFolder, visible_names
from nerfbake.formats.camera.trajectory import first_rows, is_turn, posed_cameras
from nerfbake.formats.camera.turns import pose_of_world
from nerfbake.scene.camera import Cameras

_ENDING = ".pose.txt"


def recognise(name: str, head: bytes) -> bool:
    rows = first_rows(head)
    shaped = name.endswith(_ENDING) and [len(row) for row in rows] == [4] * 4
    return shaped and is_turn([value for row in rows[:3] for value in row[:3]])


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    folder = name.rpartition("/")[0]
    names = visible_names(files, folder, _ENDING)
    require_count(len(names), name)
    album, poses, paths = Album(files, (folder, *FOLDERS)), [], []
    for each in names:
        path = f"{folder}/{each}" if folder else each
        poses.append(
            pose_of_world(
                np.array(numbers_in(bytes(files[path][:4096]).decode(errors="replace"), path, 16)).reshape(4, 4)
            )
        )
        paths.append(album.find(f"{each.removesuffix(_ENDING)}.color"))
    source = f"{folder}/*{_ENDING}" if folder else f"*{_ENDING}"
    return posed_cameras(files, poses, paths, dialect="7-Scenes", name=source, folders=(folder, *FOLDERS))
