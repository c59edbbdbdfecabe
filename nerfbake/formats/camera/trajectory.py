"""Shared by the readers of trajectories, which hold poses alone: intrinsics and pictures from files beside them.

intrinsics.txt    3 x 3, 3 x 4 or 4 x 4 numbers, or a first line `f cx cy _`, as NSVF has it
calib.txt         KITTI's: a line `P0: ` with 12 numbers, the matrix of the left camera
The pictures are those of the first folder that has some, in the order of their names, one for each pose.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, numbers_in, text_lines
from nerfbake.formats.camera.capture import CaptureFolder
from nerfbake.formats.camera.nsvf import INTRINSICS, around, read_intrinsics
from nerfbake.formats.camera.turns import taken_apart
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras

CALIBRATION = "calib.txt"


def posed_cameras(
    files: CaptureFolder,
    poses: Sequence[Floats],
    paths: Sequence[str] | None,
    *,
    dialect: str,
    name: str,
    folders: Sequence[str],
) -> Cameras:
    """Return the cameras of a trajectory. paths: of the pictures; None: all pictures in order, if there are as many.

    Raises InvalidFile if no file holds the intrinsics.
    """
    inside = _intrinsics(files, name, f"{dialect}, {plural(len(poses), 'pose')}")
    album = Album(files, folders)
    notes: tuple[str, ...] = ()
    if paths is None:
        paths = album.numbered()
        if len(paths) != len(poses):
            notes = (f"{plural(len(paths), 'picture')} for {len(poses):,} poses; the cameras are numbered",)
            paths = [""] * len(poses)
    fx, fy, cx, cy = inside
    found = [album.size(path) for path in paths]
    default = next((size for size in found if size), None)
    if default is None:
        default = around(cx, cy)
        notes = (*notes, f"no picture with a size; using {default[0]}x{default[1]}, around the principal point")
    posed = [
        Posed(path or f"{i:06d}", path, pose, size or default, (fx, fy), (cx, cy))
        for i, (path, pose, size) in enumerate(zip(paths, poses, found, strict=True))
    ]
    return cameras_of(posed, dialect=dialect, source=name, notes=notes)


def _intrinsics(files: CaptureFolder, name: str, told: str) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy."""
    if INTRINSICS in files:
        return read_intrinsics(files)
    if CALIBRATION in files:
        for number, line in text_lines(files[CALIBRATION], CALIBRATION):
            key, _, text = line.partition(":")
            if key == "P0":
                place = f"{CALIBRATION}: line {number}"
                K, _turn, _centre = taken_apart(np.array(numbers_in(text, place, 12)).reshape(3, 4), place)
                return float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2])
    allowed = f"{INTRINSICS} beside it, with the lines `fx 0 cx`, `0 fy cy`, `0 0 1`"
    raise InvalidFile(Problem(name, f"is a trajectory ({told}) without focal lengths", allowed))


def first_rows(head: bytes, rows: int = 5) -> list[list[float]]:
    """The numbers of the first whole lines of a file without comments; empty if one of them is not numbers."""
    found: list[list[float]] = []
    lines = head.removeprefix(b"\xef\xbb\xbf").splitlines()[:200]
    for line in lines[:-1] if len(lines) > 1 and not head.endswith(b"\n") else lines:
        if not line.strip() or line.lstrip().startswith(b"#"):
            continue
        try:
            found.append([float(part) for part in line.split()])
        except ValueError:
            return []
        if len(found) == rows:
            break
    return found


def is_turn(values: Sequence[float]) -> bool:
    """Whether nine numbers, row by row, are a rotation up to the rounding of a file."""
    turn = np.array(values).reshape(3, 3)
    return bool(np.isfinite(turn).all() and (np.abs(turn) < 2).all()) and bool(
        (np.abs((turn[:, None] * turn).sum(axis=2) - np.eye(3)) < 1e-3).all()
    )
