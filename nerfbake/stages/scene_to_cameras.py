"""Scene -> cameras around it, for pictures without a capture's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.maths.affine import length
from nerfbake.kernels.maths.elementary import sine_cosine
from nerfbake.kernels.maths.sphere import fibonacci
from nerfbake.scene.camera import Camera, Cameras, look_at, look_from
from nerfbake.scene.radiance_field import RadianceField, leaves_of
from nerfbake.stages._picture import Visible, frame

FIELD_OF_VIEW = np.radians(40)
_MARGIN = 1.05
_CENTRES = 1 << 17  # leaves that tell where most of them are
_STRAYS = 0.005  # of them at each end of an axis
AZIMUTH, ELEVATION = np.radians(-50), np.radians(28)


def orbit_cameras(scene: Visible, *, frames: int = 1, width: int = 800, height: int = 800) -> Cameras:
    """Cameras evenly around the scene, that frame all of it; the first looks from the front left, from above.

    Up is the scene's own z: a volume written with its z as the world's y is seen as the tree that it was made from.

    >>> from nerfbake import build_field, orbit_cameras, sample_n3tree
    >>> cameras = orbit_cameras(build_field(sample_n3tree(resolution=8)), frames=3, width=16, height=12)
    >>> [(camera.name, camera.width, camera.height) for camera in cameras.cameras]
    [('0000', 16, 12), ('0001', 16, 12), ('0002', 16, 12)]
    """
    centre, distance, axes = _stand(scene, frames)
    turns = AZIMUTH + 2 * np.pi * np.arange(frames) / frames
    poses = [look_at(centre, turn, ELEVATION, distance, axes) for turn in turns]
    return _cameras(poses, width, height, 1.0)


def sphere_cameras(scene: Visible, *, frames: int, edge: int, zoom: float = 1.0) -> Cameras:
    """Cameras evenly on the whole sphere around the scene, from below, too; edge x edge pixels.

    They look from the golden spiral of kernels.maths.sphere, whose places are others for every number of frames. zoom:
    how much larger the scene is seen than where all of it is framed.

    >>> from nerfbake import build_field, sample_n3tree, sphere_cameras
    >>> print(sphere_cameras(build_field(sample_n3tree(resolution=16)), frames=3, edge=32))
    3 cameras
    """
    centre, distance, axes = _stand(scene, frames)
    poses = [look_from(centre, away, distance, axes) for away in fibonacci(frames)]
    return _cameras(poses, edge, edge, zoom)


def without_strays(field: RadianceField) -> RadianceField:
    """The same field with a box that leaves out the outermost 0.5 % of the leaves at each end of each axis.

    Fits to photographs leave a few leaves far from the object, which would keep cameras that frame it far away.
    """
    every = -(-len(field.values) // _CENTRES)
    centres = np.concatenate([(corners + width / 2)[::every] for corners, width in leaves_of(field.cells)])
    centres.sort(axis=0)
    out = int(_STRAYS * len(centres))
    corners = np.stack([centres[out], centres[-1 - out]])
    middle, half = corners.mean(axis=0), (corners[1] - corners[0]) / (2 - 4 * _STRAYS)
    return replace(field, box=np.stack([middle - half, middle + half]).clip(*field.box))


def _stand(scene: Visible, frames: int) -> tuple[npt.NDArray[np.float64], float, npt.NDArray[np.float64]]:
    """What cameras look at, how far away they are, and the scene's axes. Raises InvalidScene for a number of frames."""
    if not 1 <= frames <= 10_000:
        raise InvalidScene(Problem("frames", f"are {frames:,}", "1 to 10,000"))
    corners, axes = frame(scene)
    radius = length(corners[1] - corners[0]) / 2
    sine, _ = (float(part) for part in sine_cosine(FIELD_OF_VIEW / 2))
    return corners.mean(axis=0), _MARGIN * radius / sine, axes


def _cameras(poses: list[npt.NDArray[np.float64]], width: int, height: int, zoom: float) -> Cameras:
    sine, cosine = (float(part) for part in sine_cosine(FIELD_OF_VIEW / 2))
    focal = zoom * (0.5 * min(width, height) * cosine / sine)
    return Cameras(tuple(Camera(width, height, focal, pose, f"{i:04d}") for i, pose in enumerate(poses)))
