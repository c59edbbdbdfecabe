"""A model of COLMAP: `cameras` with what is inside them, `images` with where they stood, both as .bin or as .txt.

cameras.bin   u64 count, each: u32 id, i32 model, u64 width, u64 height, f64 parameters, as many as the model has
images.bin    u64 count, each: u32 id, f64 qw qx qy qz tx ty tz, u32 camera id, name, NUL, u64 points, 24 bytes a point
cameras.txt   lines: id MODEL width height parameters...
images.txt    two lines each: id qw qx qy qz tx ty tz camera-id name; and the points, a line that may be empty

Little-endian. Poses are world to camera in OpenCV's axes; frames are in the order of their names. The upper left
corner of a picture is (0, 0), its first pixel's centre (0.5, 0.5), as here. Source: COLMAP's documentation, "Output
format"; its sensor/models.h.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera import colmap_binary, colmap_text
from nerfbake.formats.camera.capture import Folder, inside_of, names_of, opengl, room_for
from nerfbake.formats.camera.colmap_models import Model, Shot
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene import lens
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.camera import Camera, Cameras

# Where a capture keeps its model: COLMAP's own places, then nerfstudio's and instant-ngp's.
_PLACES = ("", "sparse/0/", "sparse/", "colmap/sparse/0/", "colmap_sparse/0/", "colmap_text/")
_PICTURES = "images/"  # in the capture's folder, wherever its model stands
_READERS = {"bin": colmap_binary, "txt": colmap_text}  # as COLMAP itself, the binary one where both are there


class _Layout(NamedTuple):
    """How many focal lengths a model's parameters start with, before cx and cy; what follows, as Lens has it."""

    focals: int
    lens: lens.LensModel | None = None
    k: tuple[int, ...] = ()  # where k1, k2, ... stand
    p: tuple[int, int] | None = None


_LAYOUTS = {
    "SIMPLE_PINHOLE": _Layout(1),
    "PINHOLE": _Layout(2),
    "SIMPLE_RADIAL": _Layout(1, "polynomial", (3,)),
    "RADIAL": _Layout(1, "polynomial", (3, 4)),
    "OPENCV": _Layout(2, "polynomial", (4, 5), (6, 7)),
    "OPENCV_FISHEYE": _Layout(2, "fisheye", (4, 5, 6, 7)),
    "FULL_OPENCV": _Layout(2, "rational", (4, 5, 8, 9, 10, 11), (6, 7)),
    "SIMPLE_RADIAL_FISHEYE": _Layout(1, "fisheye", (3,)),
    "RADIAL_FISHEYE": _Layout(1, "fisheye", (3, 4)),
}


def recognise(files: Folder) -> bool:
    return _found(files) is not None


def decode(files: Folder, *, member: str = "") -> Cameras:
    """member: the file that was asked for, where one was: its ending is the one to read."""
    place = ("", member.rpartition(".")[2]) if member else _found(files)
    if place is None or not all(f"{place[0]}{name}.{place[1]}" in files for name in ("cameras", "images")):
        raise InvalidFile(Problem("the model", "is not whole", "cameras and images, both .bin or both .txt"))
    folder, kind = place
    reader = _READERS[kind]
    models = reader.decode_models(files[f"{folder}cameras.{kind}"], f"{folder}cameras.{kind}")
    shots = sorted(reader.decode_shots(files[f"{folder}images.{kind}"], f"{folder}images.{kind}"), key=lambda s: s.name)
    room_for(len(shots))
    names = names_of(shot.name for shot in shots)
    cameras = tuple(_camera(shot, name, models) for shot, name in zip(shots, names, strict=True))
    return Cameras(cameras, "COLMAP", f"{folder}images.{kind}")


def _found(files: Folder) -> tuple[str, str] | None:
    """The folder below and the ending of the model that is taken."""
    for folder in _PLACES:
        for kind in _READERS:
            if f"{folder}cameras.{kind}" in files and f"{folder}images.{kind}" in files:
                return folder, kind
    return None


def _camera(shot: Shot, name: str, models: dict[int, Model]) -> Camera:
    if shot.model not in models:
        raise InvalidFile(Problem(f"image {name}", f"was taken by camera {shot.model}", "one that cameras has"))
    model = models[shot.model]
    if model.name not in _LAYOUTS:
        raise InvalidFile(Problem(f"camera {shot.model}", f"has the model {model.name}", ", ".join(_LAYOUTS)))
    if not (model.width <= MAX_EDGE and model.height <= MAX_EDGE):
        found = f"has {model.width:,}x{model.height:,} pixels"
        raise InvalidFile(Problem(f"camera {shot.model}", found, f"{MAX_EDGE:,} an edge"))
    layout, values = _LAYOUTS[model.name], model.parameters
    bent = None
    if layout.lens:
        p = (0.0, 0.0) if layout.p is None else (values[layout.p[0]], values[layout.p[1]])
        bent = lens.Lens(layout.lens, tuple(values[i] for i in layout.k), p)
    cx, cy = values[layout.focals : layout.focals + 2]
    focal = values[0], values[layout.focals - 1]
    picture = inside_of(shot.name)
    picture = picture and f"{_PICTURES}{picture}"
    return Camera(model.width, model.height, focal, _pose(shot, name), name, (cx, cy), bent, picture)


def _pose(shot: Shot, name: str) -> npt.NDArray[np.float64]:
    """(4, 4) camera to world, OpenGL axes."""
    w, x, y, z = shot.turn
    square = w * w + x * x + y * y + z * z
    if not 1e-12 < square < 1e12:
        raise InvalidFile(Problem(f"image {name}", f"has the quaternion {shot.turn}", "one of length 1"))
    s = 2 / square
    # Its transpose leads back: rows of R are the camera's axes in the world.
    turn = np.array(
        [
            [1 - s * (y * y + z * z), s * (x * y - w * z), s * (x * z + w * y)],
            [s * (x * y + w * z), 1 - s * (x * x + z * z), s * (y * z - w * x)],
            [s * (x * z - w * y), s * (y * z + w * x), 1 - s * (x * x + y * y)],
        ]
    )
    if not all(abs(value) <= MAX_WORLD for value in shot.shift):
        raise InvalidFile(Problem(f"image {name}", f"has the shift {shot.shift}", f"up to {MAX_WORLD:g} world units"))
    pose = np.eye(4)
    pose[:3, :3] = turn.T
    pose[:3, 3] = -(turn.T * np.array(shot.shift)).sum(axis=1)
    return opengl(pose)
