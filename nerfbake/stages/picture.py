"""Render a scene of any visible type, and return the box that frames it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.scene.atlas import BakedAtlas
from nerfbake.scene.camera import WORLD, Camera
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.image import Image
from nerfbake.scene.lattice_field import LatticeField
from nerfbake.scene.mesh import Meshes, vertex_box
from nerfbake.scene.radiance_field import RadianceField, require_field
from nerfbake.scene.splats import Splats, up_axes
from nerfbake.scene.stage1 import Stage1
from nerfbake.stages.function_to_image import render_function
from nerfbake.stages.lattice_to_image import render_lattice
from nerfbake.stages.meshes_to_image import render_meshes
from nerfbake.stages.renderers import KERNELS, Renderer
from nerfbake.stages.scene_to_field import FieldSource, build_field
from nerfbake.stages.stage1_to_image import render_stage1, surfaces

Visible = RadianceField | LatticeField | FunctionField | Meshes | Splats | Stage1 | BakedAtlas

_FRAMED = 0.18  # edge of a cube, of the distance from which orbit_cameras() frames it
_STRAYS = 0.01  # fraction of the splats to ignore at each end of an axis: real files have some far from the object


def renderable(scene: Visible | FieldSource) -> Visible:
    """Return the scene itself if it can be rendered, else its radiance field. Raises the errors of build_field()."""
    return scene if isinstance(scene, Visible) else build_field(scene)


def render_picture(scene: Visible, camera: Camera, *, samples: int = 1, render: Renderer = KERNELS) -> Image:
    """Render the scene over white, with samples x samples rays per pixel (splats: see render_splats()).

    render: renders fields and splats.
    """
    if isinstance(scene, Meshes):
        return render_meshes(scene, camera, samples=samples)
    if isinstance(scene, Stage1 | BakedAtlas):
        return render_stage1(scene, camera, samples=samples)
    if isinstance(scene, LatticeField):
        return render_lattice(scene, camera, samples=samples)
    if isinstance(scene, FunctionField):
        return render_function(scene, camera, samples=samples)
    return render(scene, camera, samples=samples)


def scene_frame(scene: Visible) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Return opposite corners (2, 3) of the box around the scene, in the world, and the scene's axes (3, 3).

    The third axis is up. It is the field's own axis, or for meshes the world's, as in nerf2mesh and its viewer. For
    splats it is the one that the file states, else -y, as in COLMAP's captures, and the box leaves out the outermost
    1 % of the centres at each end of each axis. A function is framed from where its cameras were.
    """
    if isinstance(scene, Meshes):
        return vertex_box(scene.meshes), WORLD
    if isinstance(scene, Stage1 | BakedAtlas):
        return vertex_box(surfaces(scene)), WORLD
    if isinstance(scene, LatticeField):
        return scene.held_box, np.eye(3)
    if isinstance(scene, FunctionField):
        return _box_of_function(scene), np.eye(3)
    if isinstance(scene, Splats):
        return _box_without_strays(scene), up_axes(scene.up or "-y")
    field = require_field(scene)
    return field.world(field.box), field.axes


def _box_of_function(field: FunctionField) -> npt.NDArray[np.float64]:
    """Return a cube that is framed from as far away as the field's cameras, or the field's box.

    Without cameras, a contracted field is framed from within its inner cube: cameras outside of it would not see
    through what it shows there.
    """
    from nerfbake.stages._scenery import inner_cube_of

    if field.cameras is not None and len(field.cameras.cameras) > 1:
        box, part = inner_cube_of(field.cameras), 2 * _FRAMED
    else:
        box, part = field.world_box, _FRAMED if field.contracted else 1.0
    middle, half = box.mean(axis=0), (box[1] - box[0]) / 2 * part
    return np.stack([middle - half, middle + half])


def _box_without_strays(splats: Splats) -> npt.NDArray[np.float64]:
    splats.require_usable()
    places = np.sort(splats.means, axis=0).astype(np.float64)
    out = int(_STRAYS * splats.n)
    corners = places[[out, splats.n - 1 - out]]
    middle = corners.mean(axis=0)
    # As wide as if the centres were evenly spread; one splat has a box as well.
    half = np.maximum((corners[1] - corners[0]) / (2 - 4 * _STRAYS), splats.scales.max(axis=1).mean())
    return np.stack([middle - half, middle + half])
