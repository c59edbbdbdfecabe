"""Render a scene of any visible type, and return the box that frames it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import WORLD, Camera
from nerfbake.scene.image import Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.mesh import Meshes, vertex_box
from nerfbake.scene.radiance_field import RadianceField, require_field
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.field_to_image import render_field
from nerfbake.stages.lattice_to_image import render_lattice
from nerfbake.stages.meshes_to_image import render_meshes
from nerfbake.stages.scene_to_field import FieldSource, build_field
from nerfbake.stages.stage1_to_image import render_stage1, surfaces

Visible = RadianceField | LatticeField | Meshes | Stage1 | BakedAtlas


def renderable(scene: Visible | FieldSource) -> Visible:
    """Return the scene itself if it can be rendered, else its radiance field. Raises the errors of build_field()."""
    return scene if isinstance(scene, Visible) else build_field(scene)


def render_picture(scene: Visible, camera: Camera, *, samples: int = 1) -> Image:
    """Render the scene over white, with samples x samples rays per pixel."""
    if isinstance(scene, Meshes):
        return render_meshes(scene, camera, samples=samples)
    if isinstance(scene, Stage1 | BakedAtlas):
        return render_stage1(scene, camera, samples=samples)
    if isinstance(scene, LatticeField):
        return render_lattice(scene, camera, samples=samples)
    return render_field(scene, camera, samples=samples)


def scene_frame(scene: Visible) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return opposite corners (2, 3) of the box around the scene, in the world, and the scene's axes (3, 3).

    The third axis is up. It is the field's own axis, or for meshes the world's, as in nerf2mesh and its viewer.
    """
    if isinstance(scene, Meshes):
        return vertex_box(scene.meshes), WORLD
    if isinstance(scene, Stage1 | BakedAtlas):
        return vertex_box(surfaces(scene)), WORLD
    if isinstance(scene, LatticeField):
        return scene.held_box, np.eye(3)
    field = require_field(scene)
    return field.world(field.box), field.axes
