"""Any scene that can be looked at: its picture, and what frames it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import WORLD, Camera
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Meshes, box_of
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages._field import Radiance, field_of
from nerfbake.stages.meshes_to_image import render_meshes
from nerfbake.stages.scene_to_image import render_field
from nerfbake.stages.stage1_to_image import render_stage1, surfaces

Scene = Radiance | Meshes | Stage1 | BakedAtlas


def picture(scene: Scene, camera: Camera) -> Image:
    """What the camera sees, over white."""
    if isinstance(scene, Meshes):
        return render_meshes(scene, camera)
    if isinstance(scene, Stage1 | BakedAtlas):
        return render_stage1(scene, camera)
    return render_field(scene, camera)


def frame(scene: Scene) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Opposite corners (2, 3) of the box around everything that is there, in the world, and its axes as Field has them.

    The third axis is up: a field's own, and the world's for meshes, as nerf2mesh and its viewer have it.
    """
    if isinstance(scene, Meshes):
        return box_of(scene.meshes), WORLD
    if isinstance(scene, Stage1 | BakedAtlas):
        return box_of(surfaces(scene)), WORLD
    field = field_of(scene)
    return field.world(field.box), field.axes
