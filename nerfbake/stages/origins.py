"""The origin of a scene of any type, and whether a scene has lost it."""

from __future__ import annotations

from typing import Any

import numpy as np

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import length
from nerfbake.scene.mesh import Meshes
from nerfbake.scene.origin import no_origin
from nerfbake.scene.splats import Splats


def origin_of(scene: Any) -> Floats:
    """Return the origin of splats and meshes; 0 of other scenes."""
    return scene.origin if isinstance(scene, Splats | Meshes) else no_origin()


def has_origin(scene: Any, origin: Floats) -> bool:
    """Return whether the positions of a scene are known in the world that this origin is in.

    They are if the scene has an origin, and also if it has none and lies nearer to this one than to 0. All others may
    have lost theirs to a format, and then are relative to it.
    """
    if not isinstance(scene, Splats | Meshes):
        return False
    if scene.origin.any():
        return True
    points = scene.means if isinstance(scene, Splats) else np.concatenate([mesh.positions for mesh in scene.meshes])
    middle = np.median(points, axis=0).astype(np.float64)
    return length(middle - origin) < length(middle)
