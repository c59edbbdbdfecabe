"""Where cameras see sparse points, and how far that is from where their file says."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake.scene.camera import Camera, Cameras

Floats = npt.NDArray[np.float64]


def reprojection_errors(cameras: Cameras) -> Floats:
    """(m,) pixels between each observation and its point, both on the plane in front of the camera.

    Our own rays are compared: the ray through the observed pixel and the one to the point, along the picture's axes.
    """
    points = cameras.points
    assert points is not None
    errors = np.empty(len(points.camera))
    for i, camera in enumerate(cameras.cameras):
        seen = points.camera == i
        ahead = (points.positions[points.point[seen]] - camera.pose[:3, 3]) @ camera.pose[:3, :3] * [1, -1, -1]
        away = (ahead[:, :2] / ahead[:, 2:] - plane_of(camera, points.pixel[seen])) * [camera.fx, camera.fy]
        errors[seen] = np.sqrt((away * away).sum(axis=1))
    return errors


def plane_of(camera: Camera, pixels: Floats) -> Floats:
    """(m, 2) where the rays through these places of a picture cross the plane at distance 1, x right, y down."""
    plane = (pixels - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    if camera.lens is None:
        return np.asarray(plane)
    looks, fine = camera.lens.looks(plane)
    assert fine.all()
    return np.asarray(looks[:, :2] / looks[:, 2:])


def in_pycolmap(code: str, sent: Any) -> str:
    """What code prints that reads `sent` as JSON from stdin, and uses pycolmap.

    In a process of its own: pycolmap and Pillow in one process have aborted with a corrupted heap.
    """
    if find_spec("pycolmap") is None:
        pytest.skip("needs pycolmap")
    done = subprocess.run(
        [sys.executable, "-c", code], input=json.dumps(sent), capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr[-400:]
    return done.stdout
