"""Cameras as transforms.json has them, in the dialects of NeRF-Synthetic, instant-ngp and nerfstudio.

frames            [{file_path, transform_matrix: 4 x 4, camera to world, OpenGL axes}, ...]; of a moving camera
                  transform_matrix_start and _end, of which the first is taken
x_fov, y_fov      degrees, else fl_x, fl_y: pixels, else camera_angle_x, camera_angle_y: radians; y as x unless told
cx, cy, w, h      pixels; the principal point in the middle, and the size of the pictures, unless told
samples           of this tool's own: pictures are to have so many rays along each edge of a pixel, 1 unless told
camera_model, is_fisheye, k1..k6, p1, p2, distortion_params ([k1, k2, k3, k4, p1, p2])
All but the frames and samples may stand in a frame, too, which then counts. An instant-ngp file may have comments. What
instant-ngp and nerfstudio make of the world while they train (scale, offset, aabb_scale, applied_transform) is not in
the poses.
Sources: instant-ngp's nerf_loader.cu and colmap2nerf.py; nerfstudio's nerfstudio_dataparser.py; and
docs/formats/cameras.md, "Dialects".
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from nerfbake.contract import HEAD
from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats.camera.capture import (
    DEFAULT_EDGE,
    Folder,
    PictureSizes,
    Size,
    inside_of,
    names_of,
    room_for,
    size_note,
)
from nerfbake.formats.camera.transforms_frames import parse, poses_of
from nerfbake.formats.camera.transforms_lens import LENS_KEYS, lens_fields, lens_of
from nerfbake.formats.wire.json import number, shown, whole, within
from nerfbake.kernels.maths.elementary import arctan, tangent
from nerfbake.kernels.soundness import MAX_EDGE
from nerfbake.scene.camera import FOCAL_LENGTHS, MAX_SAMPLES, Camera, Cameras

# What would change rays, and is read by nobody here: a file that has one of these, other than 0 or false, is refused.
_UNKNOWN = (
    "latlong", "equirectangular", "orthographic", "ftheta_p0", "ftheta_p1", "ftheta_p2", "ftheta_p3", "ftheta_p4",
    "ftheta_w", "ftheta_h", "s1", "s2", "s3", "s4", "sx1", "sy1", "tau_x", "tau_y", "omega", "skew", "sk_x",
    "normal_mts_args", "from_na",
)  # fmt: skip
_LEAST_ANGLE = 1e-6  # of a picture, whose focal length is a number that rays can be made with
_FOCAL = ("{}_fov", "fl_{}", "camera_angle_{}")
_OWN = {*_UNKNOWN, *LENS_KEYS, *(name.format(axis) for name in _FOCAL for axis in "xy"), "cx", "cy", "w", "h"}
_NERFSTUDIO = ("camera_model", "applied_transform", "applied_scale", "train_filenames", "ply_file_path")
_NGP = ("aabb_scale", "x_fov", "is_fisheye", "transform_matrix_start", "fl_x", "k1")

Fields = Mapping[str, Any]
Intrinsics = dict[str, Any]  # what a Camera takes beside pose and name


def recognise(view: memoryview) -> bool:
    """True for the first bytes of a transforms.json."""
    head = bytes(view[:HEAD])
    start = head.lstrip()[:2]
    told = any(key in head for key in (b"camera_angle_x", b"fl_x", b"frames", b"camera_model", b"aabb_scale"))
    return (start[:1] == b"{" or start in (b"//", b"/*")) and told


def decode(view: memoryview, *, beside: Folder | None = None) -> Cameras:
    """The cameras in the order of their frames. beside: the folder where the file and its pictures stand."""
    fields, frames = parse(view)
    room_for(len(frames))
    sizes = PictureSizes(beside)
    paths = [path if isinstance(path := frame.get("file_path"), str) else None for frame in frames]
    unsized = not all(_sized(fields, frame) for frame in frames)
    first = next((size for path in paths if (size := sizes.of(path))), None) if unsized else None
    poses = poses_of(frames)
    shared: dict[Size | None, Intrinsics] = {}
    cameras, guessed = [], 0
    for i, (frame, path, name) in enumerate(zip(frames, paths, names_of(paths), strict=True)):
        _refuse_rolling(fields, frame, i)
        seen = None if first is None else sizes.of(path)
        size = seen or first
        if _OWN.isdisjoint(frame):
            if size not in shared:
                shared[size] = _intrinsics({}, fields, size, "")
            own = shared[size]
        else:
            own = _intrinsics(frame, fields, size, f"frames[{i}]")
        guessed += seen is None and not _sized(fields, frame)
        cameras.append(Camera(pose=poses[i], name=name, picture=inside_of(path), **own))
    samples = whole(fields, "samples", default=1, low=1, high=MAX_SAMPLES)
    return Cameras(tuple(cameras), _dialect(fields, frames), notes=size_note(guessed, first), samples=samples)


def encode(cameras: Cameras) -> Iterator[bytes]:
    """Read by instant-ngp and nerfstudio, too: what all cameras have in common once, else each frame its own."""
    owns = [_fields(camera) for camera in cameras.cameras]
    alike = all(own == owns[0] for own in owns)
    frames = [
        {"file_path": camera.name, **({} if alike else own), "transform_matrix": camera.pose.tolist()}
        for camera, own in zip(cameras.cameras, owns, strict=True)
    ]
    told = {} if cameras.samples == 1 else {"samples": cameras.samples}
    yield json.dumps({**told, **(owns[0] if alike else {}), "frames": frames}, indent=1).encode() + b"\n"


def _fields(camera: Camera) -> dict[str, Any]:
    """A camera's own, but for its pose. An angle only where it is all that there is to say: for older readers."""
    fields: dict[str, Any] = {}
    middle = camera.width / 2, camera.height / 2
    if camera.lens is None and (camera.cx, camera.cy) == middle and camera.fx == camera.fy:
        fields["camera_angle_x"] = float(2 * arctan(0.5 * camera.width / camera.fx))
    fields |= {"w": camera.width, "h": camera.height, "fl_x": camera.fx, "fl_y": camera.fy}
    return fields | {"cx": camera.cx, "cy": camera.cy} | lens_fields(camera.lens)


def _sized(fields: Fields, frame: Fields) -> bool:
    return bool({"w", "h"} & (fields.keys() | frame.keys()))


def _dialect(fields: Fields, frames: list[dict[str, Any]]) -> str:
    for name, keys in (("nerfstudio", _NERFSTUDIO), ("instant-ngp", _NGP)):
        if any(key in fields or key in frames[0] for key in keys):
            return name
    return "NeRF-Synthetic"


def _intrinsics(own: Fields, shared: Fields, size: Size | None, where: str) -> Intrinsics:
    """A Camera's size, focal lengths, centre and lens."""
    both = {**shared, **{key: own[key] for key in _OWN & own.keys()}}
    for key in _UNKNOWN:
        if both.get(key) not in (None, 0, False):
            raise InvalidFile(
                Problem(within(where, key), f"is {shown(both[key])}", "perspective, or a fisheye's k1 to k4")
            )
    guessed = size is None and not {"w", "h"} & both.keys()
    told = size or (DEFAULT_EDGE, DEFAULT_EDGE)
    width, height = (
        _pixels(both, key, default if size or guessed else None, where) for key, default in zip("wh", told, strict=True)
    )
    found = _focal(own, width, height, where) or _focal(shared, width, height, "")
    if found is None:
        raise InvalidFile(Problem(within(where, "camera_angle_x"), "is missing", "it, or fl_x, or x_fov"))
    centre = None
    if {"cx", "cy"} & both.keys():
        centre = number(both, "cx", where, default=width / 2), number(both, "cy", where, default=height / 2)
    lens = lens_of(both, where)
    return {"width": width, "height": height, "focal": found, "centre": centre, "lens": lens}


def _pixels(fields: Fields, key: str, default: int | None, where: str) -> int:
    value = number(fields, key, where, default=default, low=1, high=MAX_EDGE)  # a float, where instant-ngp wrote it
    if value != int(value):
        raise InvalidFile(Problem(within(where, key), f"is {value:g}", "a whole number of pixels"))
    return int(value)


def _focal(fields: Fields, width: int, height: int, where: str) -> tuple[float, float] | None:
    """(fx, fy) as these fields have them; where they have one of the two, it is both."""
    fx, fy = _focal_along("x", width, fields, where), _focal_along("y", height, fields, where)
    if fx is None and fy is None:
        return None
    return (fx or fy or 0.0), (fy or fx or 0.0)


def _focal_along(axis: str, edge: int, fields: Fields, where: str) -> float | None:
    degrees, pixels, radians = (name.format(axis) for name in _FOCAL)
    if degrees not in fields and pixels in fields:
        return number(fields, pixels, where, low=FOCAL_LENGTHS[0], high=FOCAL_LENGTHS[1])
    key, unit, most = (degrees, "degrees", 180.0) if degrees in fields else (radians, "radians", np.pi)
    if key not in fields:
        return None
    angle = number(fields, key, where)
    if not _LEAST_ANGLE <= angle < most:
        upto = "180" if unit == "degrees" else "pi"
        raise InvalidFile(Problem(within(where, key), f"is {angle:.7g}", f"{unit} between 0 and {upto}"))
    return float(0.5 * edge / tangent((np.radians(angle) if unit == "degrees" else angle) / 2))


def _refuse_rolling(fields: Fields, frame: Fields, index: int) -> None:
    """A shutter that opens row by row gives each row a pose of its own."""
    start, end = (frame.get(f"transform_matrix_{which}") for which in ("start", "end"))
    shutter = frame.get("rolling_shutter", fields.get("rolling_shutter"))
    if end is not None and start != end and shutter and shutter != [0] * 4:
        raise InvalidFile(
            Problem(
                within(f"frames[{index}]", "transform_matrix_end"),
                "is seen through a rolling_shutter",
                "cameras that stand still",
            )
        )
