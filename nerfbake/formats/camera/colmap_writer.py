"""Cameras as the text of a COLMAP model: cameras.txt, images.txt and points3D.txt."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.formats.camera.capture import opengl
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import rotate
from nerfbake.scene.camera import Camera, Cameras
from nerfbake.scene.lens import Lens, all_round

_PICTURES = "images/"
_CLOSED = {"fov": ("FOV", 1), "division": ("DIVISION", 1), "eucm": ("EUCM", 2)}  # the model, and its coefficients
_MOST_K = 3  # of a polynomial: no model of COLMAP has r^8


class _Intrinsics(NamedTuple):
    """A line of cameras.txt without its id."""

    model: str
    width: int
    height: int
    parameters: tuple[float, ...]

    def line(self, number: int) -> str:
        return " ".join([str(number), self.model, str(self.width), str(self.height), *map(repr, self.parameters)])


def text_model(cameras: Cameras) -> Iterator[tuple[str, Iterator[bytes]]]:
    """Yield the name and the bytes of each file. Raises InvalidScene for a lens that COLMAP does not have.

    Ids count from 1. Pictures are named relative to `images`. A skew has no place in a model.
    """
    intrinsics = [_intrinsics(camera) for camera in cameras.cameras]
    numbers = {each: i for i, each in enumerate(dict.fromkeys(intrinsics), start=1)}
    yield "cameras.txt", (f"{each.line(number)}\n".encode() for each, number in numbers.items())
    yield "images.txt", _images(cameras, [numbers[each] for each in intrinsics])
    yield "points3D.txt", _points(cameras)


def _intrinsics(camera: Camera) -> _Intrinsics:
    pinhole = float(camera.fx), float(camera.fy), float(camera.cx), float(camera.cy)
    lens = camera.lens or Lens("polynomial")
    k = (*lens.k, *[0.0] * (6 - len(lens.k)))
    if lens.model == "fisheye":
        return _Intrinsics("OPENCV_FISHEYE", camera.width, camera.height, (*pinhole, *k[:4]))
    if lens.all_round:
        return _Intrinsics("EQUIRECTANGULAR", camera.width, camera.height, _all_round(camera))
    if lens.model == "thin_prism":
        values = (*pinhole, *k[:2], *lens.p, *k[2:4], lens.prism[0], lens.prism[2])
        return _Intrinsics("THIN_PRISM_FISHEYE", camera.width, camera.height, values)
    if lens.model == "prisms":
        values = (*pinhole, *k, lens.p[1], lens.p[0], *lens.prism)
        return _Intrinsics("RAD_TAN_THIN_PRISM_FISHEYE", camera.width, camera.height, values)
    if lens.model in _CLOSED:
        name, count = _CLOSED[lens.model]
        return _Intrinsics(name, camera.width, camera.height, (*pinhole, *k[:count]))
    if lens.model == "polynomial" and len(lens.k) > _MOST_K:
        found = f"has a lens with k4 = {lens.k[3]:g}"
        raise InvalidScene(Problem(f"camera {camera.name}", found, "k1 to k3: COLMAP has no model with r^8"))
    if lens.model == "rational" or len(lens.k) > 2:
        return _Intrinsics("FULL_OPENCV", camera.width, camera.height, (*pinhole, *k[:2], *lens.p, *k[2:]))
    if any(lens.k) or any(lens.p):
        return _Intrinsics("OPENCV", camera.width, camera.height, (*pinhole, *k[:2], *lens.p))
    return _Intrinsics("PINHOLE", camera.width, camera.height, pinhole)


def _all_round(camera: Camera) -> tuple[float, ...]:
    """Width and height of the picture of all directions. Raises InvalidScene for a part of one."""
    size = float(camera.width), float(camera.height)
    focal, centre, _ = all_round(*size)
    away = np.abs(np.array([camera.fx, camera.fy, camera.cx, camera.cy]) / np.array([*focal, *centre]) - 1)
    if away.max() > 1e-9:
        allowed = "a picture of all directions: COLMAP has no parts of one"
        raise InvalidScene(Problem(f"camera {camera.name}", "shows a part of the sphere", allowed))
    return size


def _images(cameras: Cameras, numbers: list[int]) -> Iterator[bytes]:
    points = cameras.points
    for i, (camera, number) in enumerate(zip(cameras.cameras, numbers, strict=True)):
        turn = opengl(camera.pose)[:3, :3].T
        shift = -rotate(camera.pose[:3, 3], turn)
        name = (camera.picture or camera.name).removeprefix(_PICTURES)
        values = " ".join(map(repr, [*quaternion_of(turn), *shift.tolist()]))
        seen = (
            ""
            if points is None
            else " ".join(
                f"{x!r} {y!r} {point + 1}"
                for (x, y), point in zip(
                    points.pixel[points.camera == i].tolist(), points.point[points.camera == i].tolist(), strict=True
                )
            )
        )
        yield f"{i + 1} {values} {number} {name}\n{seen}\n".encode()


def _points(cameras: Cameras) -> Iterator[bytes]:
    """A line for each point: id, x y z, grey, error 0, and its tracks: image and number of the place in its line."""
    points = cameras.points
    if points is None:
        return
    tracks: list[list[str]] = [[] for _ in range(len(points))]
    for i in range(len(cameras.cameras)):
        for place, point in enumerate(points.point[points.camera == i].tolist()):
            tracks[point].append(f"{i + 1} {place}")
    for number, (position, track) in enumerate(zip(points.positions.tolist(), tracks, strict=True), start=1):
        x, y, z = position
        yield f"{' '.join([f'{number} {x!r} {y!r} {z!r} 128 128 128 0', *track])}\n".encode()


def quaternion_of(turn: Floats) -> list[float]:
    """(w, x, y, z) of a rotation (3, 3), with w >= 0.

    The largest of the four is found from the diagonal, and the others from it, so that no digits cancel.
    """
    (a, b, c), (d, e, f), (g, h, i) = turn.tolist()
    squares = [1 + a + e + i, 1 + a - e - i, 1 - a + e - i, 1 - a - e + i]
    rows = [
        [squares[0], h - f, c - g, d - b],
        [h - f, squares[1], b + d, c + g],
        [c - g, b + d, squares[2], f + h],
        [d - b, c + g, f + h, squares[3]],
    ]
    row = np.array(rows[squares.index(max(squares))])
    row = row / np.sqrt((row * row).sum())
    return [float(value) + 0.0 for value in (row if row[0] >= 0 else -row)]
