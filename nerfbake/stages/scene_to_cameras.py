"""Scene -> cameras around it, for use without the cameras of a capture."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Points
from nerfbake.kernels.maths.affine import length
from nerfbake.kernels.maths.elementary import fibonacci, sine_cosine
from nerfbake.scene.base import MAX_WORLD
from nerfbake.scene.camera import Camera, Cameras, look_at, look_from
from nerfbake.scene.radiance_field import RadianceField, leaves_of
from nerfbake.stages.picture import Visible, scene_frame

FIELD_OF_VIEW = np.radians(40)
_MARGIN = 1.05
_CENTRES = 1 << 17  # largest number of leaves for the box without strays
_STRAYS = 0.005  # fraction of the leaves to ignore at each end of an axis
AZIMUTH, ELEVATION = np.radians(-50), np.radians(28)


def orbit_cameras(scene: Visible, *, frames: int = 1, width: int = 800, height: int = 800) -> Cameras:
    """Return cameras on a circle around the scene, which frame all of it. The first is front left, looking down.

    Up is the scene's own z axis. So a volume whose z was written as the world's y has the same views as its source.

    >>> from nerfbake import build_field, orbit_cameras, sample_n3tree
    >>> cameras = orbit_cameras(build_field(sample_n3tree(resolution=8)), frames=3, width=16, height=12)
    >>> [(camera.name, camera.width, camera.height) for camera in cameras.cameras]
    [('0000', 16, 12), ('0001', 16, 12), ('0002', 16, 12)]
    """
    corners, distance, axes = _stand(scene, frames)
    centre = corners.mean(axis=0)
    turns = AZIMUTH + 2 * np.pi * np.arange(frames) / frames
    poses = [look_at(centre, turn, ELEVATION, distance, axes) for turn in turns]
    return _cameras(poses, width, height, 1.0, corners)


def scatter_cameras(scene: Visible, *, frames: int, edge: int, zoom: float = 1.0) -> Cameras:
    """Return cameras of edge x edge pixels evenly on the whole sphere around the scene, also below it.

    Their positions are a Fibonacci spiral, which differs for every number of frames. zoom: magnification relative to
    the view that frames the whole scene.

    >>> from nerfbake import build_field, sample_n3tree, scatter_cameras
    >>> print(scatter_cameras(build_field(sample_n3tree(resolution=16)), frames=3, edge=32))
    3 cameras
    """
    corners, distance, axes = _stand(scene, frames)
    centre = corners.mean(axis=0)
    poses = [look_from(centre, away, distance, axes) for away in fibonacci(frames)]
    return _cameras(poses, edge, edge, zoom, corners)


def without_strays(field: RadianceField) -> RadianceField:
    """Return the field with a box that ignores the outermost 0.5 % of the leaves at each end of each axis.

    Fits to photographs leave a few leaves far from the object, which would move cameras that frame them far away.
    """
    every = -(-len(field.values) // _CENTRES)
    centres = np.concatenate([(corners + width / 2)[::every] for corners, width in leaves_of(field.cells)])
    centres.sort(axis=0)
    out = int(_STRAYS * len(centres))
    corners = np.stack([centres[out], centres[-1 - out]])
    middle, half = corners.mean(axis=0), (corners[1] - corners[0]) / (2 - 4 * _STRAYS)
    return replace(field, box=np.stack([middle - half, middle + half]).clip(*field.box))


def _stand(scene: Visible, frames: int) -> tuple[Points, float, Points]:
    """Return the corners (2, 3) of the scene's box, the distance of the cameras from its middle, and its axes (3, 3).

    Raises InvalidScene if the number of frames is out of range.
    """
    if not 1 <= frames <= 10_000:
        raise InvalidScene(Problem("frames", f"are {frames:,}", "1 to 10,000"))
    corners, axes = scene_frame(scene)
    radius = length(corners[1] - corners[0]) / 2
    sine, _ = (float(part) for part in sine_cosine(FIELD_OF_VIEW / 2))
    return corners, _MARGIN * radius / sine, axes


def _cameras(poses: list[Points], width: int, height: int, zoom: float, corners: Points) -> Cameras:
    """Return cameras around a box (2, 3). Raises InvalidScene if one of them would be out of range."""
    if not max(float(np.abs(pose[:3, 3]).max()) for pose in poses) <= MAX_WORLD:
        place = ", ".join(f"{value:.3g}" for value in corners.mean(axis=0).tolist())
        found = f"is {float((corners[1] - corners[0]).max()):.3g} world units wide, around ({place})"
        raise InvalidScene(Problem("the scene", found, f"one that cameras within {MAX_WORLD:g} world units frame"))
    sine, cosine = (float(part) for part in sine_cosine(FIELD_OF_VIEW / 2))
    focal = zoom * (0.5 * min(width, height) * cosine / sine)
    return Cameras(tuple(Camera(width, height, focal, pose, f"{i:04d}") for i, pose in enumerate(poses)))
