"""Where cameras see sparse points, and how far that is from where their file says."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

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
