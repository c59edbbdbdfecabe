"""What COLMAP's two ways of writing a model have in common: the models by number and name, and what is read."""

from __future__ import annotations

from typing import NamedTuple

# By COLMAP's number: name, and how many parameters.
MODELS = {
    0: ("SIMPLE_PINHOLE", 3),
    1: ("PINHOLE", 4),
    2: ("SIMPLE_RADIAL", 4),
    3: ("RADIAL", 5),
    4: ("OPENCV", 8),
    5: ("OPENCV_FISHEYE", 8),
    6: ("FULL_OPENCV", 12),
    7: ("FOV", 5),
    8: ("SIMPLE_RADIAL_FISHEYE", 4),
    9: ("RADIAL_FISHEYE", 5),
    10: ("THIN_PRISM_FISHEYE", 12),
}


class Model(NamedTuple):
    """What COLMAP calls a camera: what several pictures were taken with."""

    name: str
    width: int
    height: int
    parameters: tuple[float, ...]


class Shot(NamedTuple):
    """What COLMAP calls an image: turn is (w, x, y, z), and with shift leads from the world to the camera."""

    turn: tuple[float, ...]
    shift: tuple[float, ...]
    model: int
    name: str
