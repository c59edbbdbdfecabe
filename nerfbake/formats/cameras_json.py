"""Cameras as NeRF's captures have them (transforms.json).

camera_angle_x   radians, or fl_x in pixels      w, h   pixels; absent in the Blender scenes
frames           [{file_path, transform_matrix: 4 x 4, camera to world, OpenGL axes}, ...]
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import PurePosixPath
from typing import Any

import numpy as np

from nerfbake.errors import InvalidFile, Problem
from nerfbake.formats._json import parse_object
from nerfbake.scene.camera import Camera, Cameras

DEFAULT_EDGE = 800  # pixels, the size of the Blender scenes
MAX_FRAMES = 100_000


def recognise(head: bytes) -> bool:
    """True for the first bytes of a transforms.json."""
    return head.lstrip()[:1] == b"{" and (b"camera_angle_x" in head or b"fl_x" in head or b"frames" in head)


def decode(view: memoryview) -> Cameras:
    fields = parse_object(view, "the JSON", comments=True)
    frames = fields.get("frames")
    if not isinstance(frames, list) or len(frames) > MAX_FRAMES:
        raise InvalidFile(Problem("frames", "are no list", f"1 to {MAX_FRAMES:,} frames"))
    width = int(_number(fields, "w", DEFAULT_EDGE))
    height = int(_number(fields, "h", width))
    if "fl_x" in fields:
        focal = _number(fields, "fl_x")
    else:
        angle = _number(fields, "camera_angle_x")
        if not 0 < angle < np.pi:
            raise InvalidFile(Problem("camera_angle_x", f"is {angle:g}", "radians between 0 and pi"))
        focal = 0.5 * width / np.tan(angle / 2)
    return Cameras(tuple(_camera(frame, i, width, height, focal) for i, frame in enumerate(frames)))


def encode(cameras: Cameras) -> Iterator[bytes]:
    first = cameras.cameras[0]
    frames = [{"file_path": camera.name, "transform_matrix": camera.pose.tolist()} for camera in cameras.cameras]
    angle = 2 * np.arctan(0.5 * first.width / first.focal)
    fields = {
        "camera_angle_x": float(angle),
        "w": first.width,
        "h": first.height,
        "fl_x": first.focal,
        "frames": frames,
    }
    yield json.dumps(fields, indent=1).encode() + b"\n"


def _camera(frame: Any, index: int, width: int, height: int, focal: float) -> Camera:
    where = f"frames[{index}].transform_matrix"
    matrix = frame.get("transform_matrix") if isinstance(frame, dict) else None
    try:
        pose = np.array(matrix, np.float64)
    except (TypeError, ValueError):
        raise InvalidFile(Problem(where, "is no matrix", "4 x 4 numbers")) from None
    if pose.shape != (4, 4) or not np.isfinite(pose).all() or not abs(np.linalg.det(pose[:3, :3])) > 1e-12:
        found = f"has shape {pose.shape}" if pose.shape != (4, 4) else "is singular or not finite"
        raise InvalidFile(Problem(where, found, "4 x 4 finite numbers, an invertible rotation"))
    path = frame.get("file_path")
    return Camera(width, height, focal, pose, PurePosixPath(path).stem if isinstance(path, str) else f"{index:04d}")


def _number(fields: dict[str, Any], name: str, default: float | None = None) -> float:
    value = fields.get(name, default)
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value) or not 0 < value < 1e9:
        found = "is missing" if value is None else f"is {str(value)[:40]}"
        raise InvalidFile(Problem(name, found, "a finite number above 0"))
    return float(value)
