"""Read Bundler's bundle.out, with list.txt beside it, whose lines start with the names of the pictures.

# Bundle file v0.3
cameras points
for each camera    f k1 k2, three rows of R, t
for each point     x y z, r g b, then n and n times: camera, key, x, y

P = R X + t with axes right, UP, BACK, so the camera looks along -z; f is in pixels, u = w/2 + f r p_x, v = h/2 - f r
p_y, r = 1 + k1 |p|^2 + k2 |p|^4. The file has no sizes: they come from the pictures. A camera with f = 0 has no pose.
The places of points count from the middle, upwards.
Source: Bundler's manual; COLMAP's ExportBundler(); 1.23 pixels, the median of 14,988 observations of a real capture.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.album import Album, Posed, cameras_of, numbers_in, require_count, text_lines
from nerfbake.formats.camera.capture import CaptureFolder, Size
from nerfbake.formats.camera.turns import pose_shifted
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.soundness import plural
from nerfbake.scene.camera import Cameras
from nerfbake.scene.lens import Lens
from nerfbake.scene.sparse_points import SparsePoints

_MARK = b"# Bundle file"
_LISTS = ("list.txt", "pictures.txt")
_FLIP = np.array([1.0, -1.0, -1.0])
_MAX_LINE = 1 << 20  # bytes of a line: a point may be seen by all cameras
_POINT = 300  # bytes of memory of a point


def recognise(name: str, head: bytes) -> bool:
    return head.removeprefix(b"\xef\xbb\xbf").startswith(_MARK)


def decode(files: CaptureFolder, *, name: str) -> Cameras:
    lines = _Lines(files, name)
    cameras, points = (int(value) for value in lines.numbers(2))
    require_count(cameras, name)
    labels = _labels(files, name, cameras)
    album = Album(files)
    registered, turns, shifts, inside = [], list[Floats](), list[Floats](), []
    for i in range(cameras):
        f, k1, k2 = lines.numbers(3)
        turn = np.array([lines.numbers(3) for _ in range(3)])
        shift = np.array(lines.numbers(3))
        if f != 0:
            registered.append(i)
            turns.append(turn * _FLIP[:, None])
            shifts.append(shift * _FLIP)
            inside.append((f, k1, k2))
    if not registered:
        raise InvalidFile(Problem(name, f"has {plural(cameras, 'camera')} without a pose", "cameras with f above 0"))
    paths = [album.find(labels[i]) for i in registered]
    sizes, notes = album.sizes(paths)
    posed = [
        Posed(labels[i], path, pose_shifted(turn, shift), size, (f, f), None, Lens("polynomial", (k1, k2)))
        for i, path, turn, shift, size, (f, k1, k2) in zip(registered, paths, turns, shifts, sizes, inside, strict=True)
    ]
    if left := cameras - len(registered):
        notes = (*notes, f"{plural(left, 'camera')} of {cameras:,} without a pose left out")
    numbers = {i: number for number, i in enumerate(registered)}
    found = lines.points(points, numbers, sizes) if points else None
    return cameras_of(posed, dialect="Bundler", source=name, notes=notes, points=found)


def _labels(files: CaptureFolder, name: str, cameras: int) -> list[str]:
    folder = name.rpartition("/")[0]
    paths = [f"{folder}/{each}".removeprefix("/") for each in (*_LISTS, f"{name.rpartition('/')[2]}.list.txt")]
    path = next((path for path in paths if path in files), None)
    if path is None:
        raise InvalidFile(Problem(name, "has no names of pictures", "list.txt beside it, a line for each camera"))
    labels = [line.split()[0] for _, line in text_lines(files[path], path)]
    if len(labels) != cameras:
        raise InvalidFile(Problem(path, f"has {len(labels):,} lines", f"{cameras:,}, one for each camera of {name}"))
    return labels


class _Lines:
    """The lines of the file, one after the other."""

    def __init__(self, files: CaptureFolder, name: str) -> None:
        self._name, self._lines = name, text_lines(files[name], name, most=_MAX_LINE)
        self._number = 0

    def numbers(self, count: int | None = None) -> list[float]:
        self._number, line = self._next()
        return numbers_in(line, f"{self._name}: line {self._number:,}", count)

    def _next(self) -> tuple[int, str]:
        for number, line in self._lines:
            return number, line
        raise InvalidFile(
            Problem(self._name, f"ends after line {self._number:,}", "all cameras and points that it counts")
        )

    def points(self, count: int, numbers: dict[int, int], sizes: list[Size]) -> SparsePoints:
        positions, camera, point, pixel = [], list[int](), list[int](), list[tuple[float, float]]()
        for i in range(count):
            memory.hold(f"the points of {self._name}", _POINT)
            positions.append(self.numbers(3))
            self.numbers(3)  # the colour
            for seen, x, y in _observations(self.numbers(), f"{self._name}: line {self._number:,}"):
                if seen in numbers:
                    width, height = sizes[numbers[seen]]
                    camera.append(numbers[seen])
                    point.append(i)
                    pixel.append((width / 2 + x, height / 2 - y))
        memory.hold(f"the points of {self._name}", _POINT * len(camera))
        return SparsePoints(
            np.array(positions), np.array(camera, np.int64), np.array(point, np.int64), np.array(pixel).reshape(-1, 2)
        )


def _observations(values: list[float], place: str) -> Iterator[tuple[int, float, float]]:
    if len(values) != 1 + 4 * values[0]:
        raise InvalidFile(Problem(place, f"has {len(values):,} numbers", "n, then 4 for each of n pictures"))
    for at in range(1, len(values), 4):
        yield int(values[at]), values[at + 2], values[at + 3]
