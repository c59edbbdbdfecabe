"""Any scene that can be looked at: its picture, and the box that frames it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Meshes, box_of
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages._field import field_of
from nerfbake.stages.meshes_to_image import draw
from nerfbake.stages.scene_to_image import render
from nerfbake.stages.stage1_to_image import shade, surfaces

Field = N3Tree | SparseVoxelOctree
Scene = Field | Meshes | Stage1 | BakedAtlas


def picture(scene: Scene, camera: Camera) -> Image:
    """What the camera sees, over white."""
    if isinstance(scene, Meshes):
        return draw(scene, camera)
    if isinstance(scene, Stage1 | BakedAtlas):
        return shade(scene, camera)
    return render(scene, camera)


def box(scene: Scene) -> npt.NDArray[np.float64]:
    """(2, 3) world corners of the box around everything that is there."""
    if isinstance(scene, Meshes):
        return box_of(scene.meshes)
    if isinstance(scene, Stage1 | BakedAtlas):
        return box_of(surfaces(scene))
    return field_of(scene).occupied_box()


def up(scene: Scene) -> str:
    """The axis that points up: a capture's z, but y in nerf2mesh's own world."""
    return "y" if isinstance(scene, Stage1 | BakedAtlas) else "z"
