"""Read LLFF's poses_bounds.npy: (n, 17) float64, for each picture 3 x 5 numbers [axes, position, (h, w, f)], near, far.

The axes are columns: down, right, back. The (n, 14) variant has no fifth column; hwf_cxcy.npy in the same folder
contains h, w, then f, or f, cx, cy, or fx, fy, cx, cy, for all pictures. The pictures are in `images`, sorted by name.
The poses do not include the transforms that trainers apply to the world (scale by the nearest bound, recentring,
spherifying).
Sources: LLFF's README; NeX's load_llff.py; docs/formats/cameras.md, "Dialects".
"""

from __future__ import annotations

import io
import math

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.contract import PICTURES
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import CaptureFolder, names_of, room_for, visible_names
from nerfbake.formats.wire.npy import read_header
from nerfbake.kernels.maths.elementary import cast
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.camera import Camera, Cameras

_NAME, _SHARED = "poses_bounds.npy", "hwf_cxcy.npy"


def recognise(files: CaptureFolder) -> bool:
    return _NAME in files


def decode(files: CaptureFolder, *, member: str = "") -> Cameras:
    rows = _array(files, _NAME)
    if rows.ndim != 2 or rows.shape[1] not in (14, 17):
        raise InvalidFile(Problem(_NAME, f"has shape {rows.shape}", "(n, 17), or (n, 14) beside hwf_cxcy.npy"))
    n = len(rows)
    room_for(n)
    parts = rows[:, :-2].reshape(n, 3, -1)
    inside = [_own(hwf) for hwf in parts[:, :, 4]] if rows.shape[1] == 17 else [_shared(files)] * n
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, :3] = np.stack([parts[:, :, 1], -parts[:, :, 0], parts[:, :, 2], parts[:, :, 3]], axis=2)
    pictures = visible_names(files, "images", PICTURES)
    paths = [f"images/{name}" for name in pictures] if len(pictures) == n else [""] * n
    names = names_of(paths)
    notes = (
        ()
        if len(pictures) in (0, n)
        else (f"images has {len(pictures):,} pictures for {n:,} cameras; the cameras are numbered",)
    )
    cameras = [
        Camera(width, height, focal, pose, name, centre, picture=path)
        for (width, height, focal, centre), pose, name, path in zip(inside, poses, names, paths, strict=True)
    ]
    return Cameras(tuple(cameras), "LLFF", _NAME, notes)


_Inside = tuple[int, int, tuple[float, float], tuple[float, float] | None]


def _own(hwf: npt.NDArray[np.float64]) -> _Inside:
    height, width, focal = hwf.tolist()
    return _edge(width, _NAME), _edge(height, _NAME), (focal, focal), None


def _shared(files: CaptureFolder) -> _Inside:
    if _SHARED not in files:
        raise InvalidFile(Problem(_SHARED, "is missing", f"a file in the folder of a {_NAME} of shape (n, 14)"))
    values = _array(files, _SHARED)
    if values.size not in (3, 5, 6):
        raise InvalidFile(
            Problem(_SHARED, f"has shape {values.shape}", "h, w, f; h, w, f, cx, cy; h, w, fx, fy, cx, cy")
        )
    height, width, fx, *others = values.reshape(-1).tolist()
    fy = others[0] if len(others) == 3 else fx
    return _edge(width, _SHARED), _edge(height, _SHARED), (fx, fy), (others[-2], others[-1]) if others else None


def _edge(value: float, name: str) -> int:
    if value != int(value):
        raise InvalidFile(Problem(name, f"has a picture {value:g} pixels wide or high", "whole numbers"))
    return int(value)


def _array(files: CaptureFolder, name: str) -> npt.NDArray[np.float64]:
    view = files[name]
    stream = io.BytesIO(view)
    shape, fortran, dtype = read_header(name, stream)
    size = dtype.itemsize * math.prod(shape)
    if dtype.kind not in "fiu" or size != len(view) - stream.tell():
        found = f"declares {size:,} bytes of {dtype} before {len(view) - stream.tell():,}"
        raise InvalidFile(Problem(name, found, "the number of bytes in the file"))
    memory.hold(name, 24 * (size // dtype.itemsize))  # as float64, as slices, and as poses
    flat = cast(np.frombuffer(view, dtype, offset=stream.tell()), np.float64)
    if not (np.abs(flat) <= MAX_WORLD).all():
        raise InvalidFile(Problem(name, "holds a number that is not finite or too large", f"up to {MAX_WORLD:g}"))
    return flat.reshape(shape, order="F" if fortran else "C")
