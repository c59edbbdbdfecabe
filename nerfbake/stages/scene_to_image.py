"""Scene and camera -> picture: the reference that every bake is judged by."""

from __future__ import annotations

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.sh import sh_basis
from nerfbake.kernels.traversal import march
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import Image
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.octree import SparseVoxelOctree
from nerfbake.stages._field import field_of

WHITE = (1.0, 1.0, 1.0)


def render(
    scene: N3Tree | SparseVoxelOctree,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    transmittance_cut: float = 1e-4,
) -> Image:
    """What the camera sees of the scene. Source: spec/n3tree.md, "How it is rendered".

    Emission and absorption along the ray through each pixel's centre, front to back over a background (sRGB in 0..1;
    None: transparent), each leaf a cell of constant density and of the colour that it has in the ray's direction. A ray
    ends where it lets less than transmittance_cut through. Raises InvalidScene for broken scenes and SG and ASG bases.
    """
    if not 0 <= transmittance_cut < 1:
        raise InvalidScene(Problem("transmittance_cut", f"is {transmittance_cut:g}", "0 to 1, without 1"))
    field = field_of(scene)
    place, directions = camera.rays()
    basis = np.ones((len(directions), 1)) if field.basis.kind == "RGBA" else sh_basis(directions, field.basis.size)
    out = np.empty((len(directions), 5), np.float32)
    march(
        field.slots,
        field.N,
        field.values,
        place * field.scale + field.offset,
        directions * field.scale,
        basis.astype(np.float32),
        transmittance_cut,
        out,
    )
    colour, alpha, far = out[:, :3], out[:, 3], out[:, 4]
    if background is not None:
        colour = colour + (1 - alpha[:, None]) * np.array(background, np.float32)
    shape = (camera.height, camera.width)
    depth = np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)
    return Image(colour.reshape(*shape, 3), alpha.reshape(shape), depth.reshape(shape), background)
