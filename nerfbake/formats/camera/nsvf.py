"""Read NSVF captures, also used for Tanks and Temples and BlendedMVS.

pose/NAME.txt    4 x 4 camera to world, OpenCV's axes; or in poses/
intrinsics.txt   4 x 4, 3 x 4 or 3 x 3 numbers; or 16 in a line; or a first line `f cx cy _`, followed by other data
rgb/NAME.png     the pictures; only they contain the size
Lines of two numbers are skipped. All splits (prefixes 0_, 1_, 2_) are read, sorted by name.
Source: NSVF's data_utils.py; docs/formats/cameras.md, "Dialects".
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import (
    CaptureFolder,
    PictureSizes,
    Size,
    names_of,
    opengl,
    room_for,
    visible_names,
)
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.camera import Camera, Cameras

INTRINSICS = "intrinsics.txt"
_POSES = ("pose", "poses")
_MAX_SIZE = 1 << 16  # bytes of a file of a few numbers

_FREE = (0, 0), (1, 1), (0, 2), (1, 2)  # places of fx, fy, cx, cy in a matrix

_Rows = list[list[float]]


def recognise(files: CaptureFolder) -> bool:
    return INTRINSICS in files and any(files.names(folder) for folder in _POSES)


def decode(files: CaptureFolder, *, member: str = "") -> Cameras:
    folder = next((folder for folder in _POSES if files.names(folder)), _POSES[0])
    stems = [name.removesuffix(".txt") for name in visible_names(files, folder, ".txt")]
    room_for(len(stems))
    fx, fy, cx, cy = read_intrinsics(files)
    sizes = PictureSizes(files)
    found = [sizes.of(f"rgb/{stem}") for stem in stems]
    default = next((size for size in found if size), None) or around(cx, cy)
    notes: tuple[str, ...] = ()
    if not any(found):
        missing = f"no readable picture in rgb ({sizes.unreadable} cannot be read)" if sizes.unreadable else ""
        using = f"using {default[0]}x{default[1]}, with the principal point in the centre"
        notes = (f"{missing or 'no picture in rgb'}; {using}",)
    cameras = []
    for stem, size, name in zip(stems, found, names_of(stems), strict=True):
        width, height = size or default
        pose = opengl(_matrix(_rows(files, f"{folder}/{stem}.txt"), f"{folder}/{stem}.txt"))
        cameras.append(Camera(width, height, (fx, fy), pose, name, (cx, cy), picture=f"rgb/{stem}"))
    return Cameras(tuple(cameras), "NSVF", f"{INTRINSICS}, {folder}/*.txt", notes)


def read_intrinsics(files: CaptureFolder) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of the folder's intrinsics.txt."""
    rows = _rows(files, INTRINSICS)
    edges = [len(row) for row in rows]
    if edges in ([16], [4] * 4, [4] * 3, [3] * 3):
        K = np.array(rows).reshape(-1, edges[-1] if len(edges) > 1 else 4)
        for (row, column), allowed in np.ndenumerate(np.eye(3, K.shape[1])):
            if (row, column) not in _FREE and K[row, column] != allowed:
                name = "skew" if (row, column) == (0, 1) else f"K[{row}, {column}]"
                raise InvalidFile(Problem(f"{INTRINSICS}: {name}", f"is {K[row, column]:g}", f"{allowed:g}"))
        fx, fy, cx, cy = (float(K[place]) for place in _FREE)
        return fx, fy, cx, cy
    if not edges or edges[0] not in (3, 4) or edges[:1] == edges[1:2]:  # equal lines are those of a matrix
        found = f"has lines of {', '.join(map(str, edges[:8])) or 'no'} numbers"
        raise InvalidFile(Problem(INTRINSICS, found, "4 x 4, 3 x 4, 3 x 3, or a first line f cx cy _"))
    f, cx, cy = rows[0][:3]
    return f, f, cx, cy


def _matrix(rows: _Rows, name: str) -> npt.NDArray[np.float64]:
    numbers = [value for row in rows for value in row]
    if len(numbers) != 16:
        raise InvalidFile(Problem(name, f"has {len(numbers)} numbers", "4 x 4"))
    return np.array(numbers).reshape(4, 4)


def _rows(files: CaptureFolder, name: str) -> _Rows:
    """Parse the numbers of each line. Lines of two numbers are skipped."""
    view = files[name]
    if len(view) > _MAX_SIZE:
        raise InvalidFile(Problem(name, f"has {len(view):,} bytes", f"up to {_MAX_SIZE:,}"))
    try:
        rows = [list(map(float, line.split())) for line in bytes(view).decode("utf-8-sig").splitlines()]
    except ValueError:
        raise InvalidFile(Problem(name, "holds a value that is not a number", "lines of numbers")) from None
    if not all(abs(value) <= MAX_WORLD for row in rows for value in row):
        raise InvalidFile(Problem(name, "holds a number that is not finite or too large", f"up to {MAX_WORLD:g}"))
    return [row for row in rows if len(row) not in (0, 2)]


def around(cx: float, cy: float) -> Size:
    """Return the size of a picture with its centre at (cx, cy)."""
    return max(1, round(2 * cx)), max(1, round(2 * cy))
