"""Cameras as prims of USD: the reader of all containers, and what the writers of each container share.

    Xform "scene"
        Camera "r_0", ...
            matrix4d xformOp:transform              the pose, rows and columns exchanged: USD multiplies from the left
            float focalLength, horizontalAperture, verticalAperture, their offsets       tenths of a world unit
            float2 clippingRange                    world units
            custom int[] nerfbake:size              width and height of the picture in pixels, which USD does not have
            custom string nerfbake:picture          its path

A camera of USD looks along -z, its y is up, as here. fx = width focalLength / horizontalAperture. An offset above 0
moves the picture to +x, +y on the plane in front of the camera. Lens distortion cannot be stored. Poses are in the
world in which the splats of the same file are read, else in that of the stage.
Source: OpenUSD 26.11, usdGeom/camera.h and gf/camera.h.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from nerfbake.errors import InvalidFile, InvalidScene, Problem
from nerfbake.formats.camera.capture import DEFAULT_EDGE, names_of, room_for
from nerfbake.formats.wire.usd.content import has_type
from nerfbake.formats.wire.usd.reading import StagePrim, read_stage
from nerfbake.formats.wire.usd.stage import Attribute, Prim, Relationship, UsdStage, prim_names
from nerfbake.kernels.maths.affine import length
from nerfbake.scene.camera import Camera, Cameras

KIND = "Camera"
_APERTURE = 0.36  # of pictures that are written: 36 mm if the world unit is a metre
_CLIPPED = (0.01, 10_000.0)  # world units from the camera
_DEFAULTS = {"focalLength": 50.0, "horizontalAperture": 20.955, "verticalAperture": 15.2908}
_ROUNDING = 1e-6
_SIZE, _PICTURE = "nerfbake:size", "nerfbake:picture"
_FLIP = np.array([[1.0], [-1.0], [-1.0]])


def camera_stage(cameras: Cameras, *, up: Literal["y", "z"]) -> UsdStage:
    """Return the stage of cameras, whose world has this axis up. Raises InvalidScene for lens distortion."""
    names = prim_names((camera.name for camera in cameras.cameras), default="camera")
    prims = tuple(_prim(name, camera) for name, camera in zip(names, cameras.cameras, strict=True))
    return UsdStage(Prim("scene", "Xform", children=prims), "Z" if up == "z" else "Y")


def _prim(name: str, camera: Camera) -> Prim:
    if camera.bends:
        allowed = "a pinhole, or transforms.json; USD has no distortion"
        raise InvalidScene(Problem(f"camera {camera.name}".strip(), "has lens distortion", allowed))
    wide = _APERTURE
    focal = camera.fx * wide / camera.width
    high = camera.height * focal / camera.fy
    properties: dict[str, Attribute | Relationship] = {
        "projection": Attribute("token", "perspective"),
        "focalLength": Attribute("float", focal),
        "horizontalAperture": Attribute("float", wide),
        "verticalAperture": Attribute("float", high),
        "horizontalApertureOffset": Attribute("float", (camera.width / 2 - camera.cx) * wide / camera.width),
        "verticalApertureOffset": Attribute("float", (camera.cy - camera.height / 2) * high / camera.height),
        "clippingRange": Attribute("float2", _CLIPPED),
        "xformOp:transform": Attribute("matrix4d", camera.pose.T),
        "xformOpOrder": Attribute("token[]", ["xformOp:transform"], uniform=True),
        _SIZE: Attribute("int[]", [camera.width, camera.height], uniform=True, custom=True),
        _PICTURE: Attribute("string", camera.picture or camera.name, uniform=True, custom=True),
    }
    return Prim(name, KIND, properties)


def recognise(view: memoryview) -> bool:
    """Return True for a file of USD that names cameras."""
    return has_type(view, KIND)


def decode(view: memoryview) -> Cameras:
    """Read the cameras of a stage, each at its first time. Raises UsageError without OpenUSD, InvalidFile."""
    stage = read_stage(view)
    prims = stage.of(KIND)
    if not prims:
        raise InvalidFile(Problem("the stage", "has no cameras", "a Camera"))
    room_for(len(prims))
    flipped = stage.up == "Y" and bool(stage.of("ParticleField3DGaussianSplat"))
    paths = [str(prim.values.get(_PICTURE) or prim.path.rpartition("/")[2]) for prim in prims]
    named = zip(prims, names_of(paths), paths, strict=True)
    cameras = [_camera(prim, name, path, flipped=flipped) for prim, name, path in named]
    notes = list(stage.notes)
    if unsized := sum(_SIZE not in prim.values for prim in prims):
        notes.append(
            f"{unsized:,} of {len(prims):,} cameras tell no size of a picture; {DEFAULT_EDGE} pixels are assumed"
        )
    return Cameras(tuple(cameras), "USD", notes=tuple(notes))


def _camera(prim: StagePrim, name: str, path: str, *, flipped: bool) -> Camera:
    if prim.values.get("projection", "perspective") != "perspective":
        raise InvalidFile(Problem(prim.path, f"has the projection {prim.values['projection']!s:.20}", "perspective"))
    focal, wide, high = (_number(prim, name, default) for name, default in _DEFAULTS.items())
    if not min(focal, wide, high) > 0:
        found = f"has a focal length of {focal:g} and apertures of {wide:g} and {high:g}"
        raise InvalidFile(Problem(prim.path, found, "numbers above 0"))
    width, height = _size(prim, high / wide)
    fx, fy = width * focal / wide, height * focal / high
    if abs(fx - fy) <= _ROUNDING * fx:  # the rounding of float32
        fy = fx
    right, above = (_number(prim, f"{side}ApertureOffset", 0.0) for side in ("horizontal", "vertical"))
    centre = None
    if right or above:
        centre = width / 2 - right * width / wide, height / 2 + above * height / high
    pose = prim.place.copy()
    if abs(scale := length(pose[:3, 0]) - 1) > _ROUNDING and scale > -1:
        pose[:3, :3] /= scale + 1  # the unit of the stage
    if flipped:
        pose[:3] = _FLIP * pose[:3]
    return Camera(width, height, fx if fx == fy else (fx, fy), pose, name, centre, picture=path)


def _size(prim: StagePrim, ratio: float) -> tuple[int, int]:
    """Return width and height in pixels; without them the default width, and the height by the apertures."""
    found: Any = prim.values.get(_SIZE)
    if isinstance(found, np.ndarray) and len(found) == 2 and found.dtype.kind == "i":
        return int(found[0]), int(found[1])
    return DEFAULT_EDGE, max(1, min(round(DEFAULT_EDGE * ratio), 100 * DEFAULT_EDGE))


def _number(prim: StagePrim, name: str, default: float) -> float:
    value = prim.values.get(name, default)
    if not isinstance(value, int | float) or not math.isfinite(value):
        raise InvalidFile(Problem(f"{prim.path}.{name}", f"is {value!s:.20}", "a finite number"))
    return float(value)
