"""Read NAME_cam.txt of MVSNet, BlendedMVS and DTU, one for each picture, in `cams`.

extrinsic, 4 x 4 world to camera, OpenCV's axes; intrinsic, 3 x 3 in pixels; depth_min interval [n [depth_max]]

NAME_cam.txt belongs to the picture NAME. The file has no size. Pictures may have been reduced without the intrinsics,
so a picture is refused if the principal point is not near its middle.
Source: "Camera Files" in the README of YoYo000/MVSNet, E = [R|t] and K; three public readers agree with it. No real
file was checked, and a note says so.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import FOLDERS, Album, Posed, cameras_of, finite, require_count
from nerfbake.formats.camera.capture import CaptureFolder, Size, visible_names
from nerfbake.formats.camera.nsvf import around
from nerfbake.formats.camera.turns import pose_shifted
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens

_ENDING = "_cam.txt"
_FOLDERS = (*FOLDERS, "blended_images", "rectified")
_START = re.compile(rb"^(?:\xef\xbb\xbf)?\s*extrinsic\s")
_MAX_SIZE = 1 << 16
_OFF = 0.25  # of an edge: how far the principal point may be from the middle
_UNCHECKED = "warning: files of MVSNet are read by its own description; no real one was checked"


def recognise(name: str, head: bytes) -> bool:
    return name.endswith(_ENDING) and _START.match(head) is not None


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    folder = name.rpartition("/")[0]
    names = visible_names(files, folder, _ENDING)
    require_count(len(names), name)
    album, notes, posed = Album(files, _FOLDERS), (_UNCHECKED,), []
    for each in names:
        path = f"{folder}/{each}" if folder else each
        turn, K = _matrices(files, path)
        label = each.removesuffix(_ENDING)
        picture = album.find(label)
        size = _size(album.size(picture), K, path)
        focal, centre = (float(K[0][0]), float(K[1][1])), (float(K[0][2]), float(K[1][2]))
        lens = Lens("polynomial", skew=float(K[0][1]) / (focal[0] or 1))
        posed.append(Posed(label, picture, pose_shifted(turn[:3, :3], turn[:3, 3]), size, focal, centre, lens))
    source = f"{folder}/*{_ENDING}" if folder else f"*{_ENDING}"
    return cameras_of(posed, dialect="MVSNet", source=source, notes=notes)


def _matrices(files: CaptureFolder, name: str) -> tuple[np.ndarray, Sequence[Sequence[float]]]:
    """Return the matrix of the extrinsics (4, 4) and the rows of K."""
    view = files[name]
    if len(view) > _MAX_SIZE:
        raise InvalidFile(Problem(name, f"has {len(view):,} bytes", f"up to {_MAX_SIZE:,}"))
    words = bytes(view).decode("utf-8-sig", errors="replace").split()
    if len(words) < 27 or words[0] != "extrinsic" or words[17] != "intrinsic":
        raise InvalidFile(Problem(name, f"has {len(words):,} words", "extrinsic, 16 numbers, intrinsic, 9 numbers"))
    K = np.array(finite(words[18:27], name)).reshape(3, 3).tolist()
    return np.array(finite(words[1:17], name)).reshape(4, 4), K


def _size(found: Size | None, K: Sequence[Sequence[float]], name: str) -> Size:
    """The size of the picture, or one around the principal point if there is no picture."""
    cx, cy = K[0][2], K[1][2]
    if found is None:
        return around(cx, cy)
    if any(abs(2 * c - edge) > 2 * _OFF * edge for c, edge in ((cx, found[0]), (cy, found[1]))):
        told = f"has its principal point at {cx:.6g}, {cy:.6g} in a picture of {found[0]}x{found[1]}"
        raise InvalidFile(Problem(name, told, "one near the middle: pictures and intrinsics of the same size"))
    return found
