"""Scene -> cameras around it, for pictures without a capture's own."""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.camera import Camera, Cameras, look_at
from nerfbake.stages._picture import Scene, box, up

FIELD_OF_VIEW = np.radians(40)
MARGIN = 1.05
AZIMUTH, ELEVATION = np.radians(-50), np.radians(28)


def orbit(scene: Scene, *, frames: int = 1, width: int = 800, height: int = 800) -> Cameras:
    """Cameras evenly around the scene, z up, that frame all of it; the first looks from the front left, from above.

    nerf2mesh's own world has y up, and its scenes are framed so.
    """
    if not 1 <= frames <= 10_000:
        raise InvalidScene(Problem("frames", f"are {frames:,}", "1 to 10,000"))
    low, high = box(scene)
    radius = float(np.linalg.norm(high - low)) / 2
    distance = MARGIN * radius / np.sin(FIELD_OF_VIEW / 2)
    focal = 0.5 * min(width, height) / np.tan(FIELD_OF_VIEW / 2)
    turns = AZIMUTH + 2 * np.pi * np.arange(frames) / frames
    poses = [look_at((low + high) / 2, turn, ELEVATION, distance, up=up(scene)) for turn in turns]
    return Cameras(tuple(Camera(width, height, focal, pose, f"{i:04d}") for i, pose in enumerate(poses)))
