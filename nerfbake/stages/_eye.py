"""A camera for the kernels of splats."""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose, inverse, length
from nerfbake.kernels.splat.project import Eye
from nerfbake.scene.camera import Camera

_MARGIN = 0.3  # the Jacobian is that of a point at most this share of half the picture outside of it


def eye_of(camera: Camera) -> tuple[Eye, Floats]:
    """Return a camera for the kernels, and the places (H, W, 2) of its pixels' centres in a pinhole camera's picture.

    The places are empty for a camera without distortion. Raises InvalidScene for a lens that does not cover the
    picture, and for one that looks backwards.
    """
    right, up, back = camera.pose[:3, :3].T
    axes = np.stack([right, -up, -back], axis=1) / length(back)
    low, high = np.zeros(2), np.array([camera.width, camera.height], np.float64)
    places = np.empty((0, 0, 2))
    focal, centre = np.array([camera.fx, camera.fy]), np.array([camera.cx, camera.cy])
    if camera.bends:
        plane = camera.plane()
        if plane is None:
            name = f"camera {camera.name}".strip()
            raise InvalidScene(Problem(name, "looks backwards through its lens", "less than 180 degrees for splats"))
        places = plane * focal + centre
        low, high = places.min(axis=(0, 1)) - 0.5, places.max(axis=(0, 1)) + 0.5
    margin = _MARGIN * (high - low) / 2
    limits = np.stack([low - margin - centre, high + margin - centre], axis=1) / focal[:, None]
    eye = Eye(
        camera.pose[:3, 3].copy(),
        inverse(axes),
        compose(np.ascontiguousarray(axes.T), axes),
        float(camera.fx),
        float(camera.fy),
        float(camera.cx),
        float(camera.cy),
        limits.reshape(-1),
        np.concatenate([low, high]),
    )
    return eye, places
