"""Meshes and camera -> picture."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.surface.normals import face_normals
from nerfbake.kernels.surface.texture import bilinear, nearest_texel
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.mesh import Meshes
from nerfbake.stages._supersampled import supersampled
from nerfbake.stages._surface import Hits, shade_surfaces

GREY = np.float32(0.75)
_AMBIENT = np.float32(0.25)  # fraction of the colour where a surface is viewed edge-on


def render_meshes(
    scene: Meshes,
    camera: Camera,
    *,
    background: tuple[float, float, float] | None = WHITE,
    samples: int = 1,
    lit: bool = True,
) -> Image:
    """Render opaque, two-sided triangles as seen by a camera, over a background (None: transparent).

    Textures are interpolated bilinearly, or with holes show the nearest texel, and are not lit. A mesh without a
    texture is grey, or has its vertex colours, and is lit from the camera; lit=False: its colours are radiance, and are
    shown as they are. Alpha is 0 or 1 for a ray, and depth is the distance along it. With one ray per pixel, edges are
    not smoothed; samples x samples rays are averaged as in render_field().

    >>> import numpy as np
    >>> from nerfbake import Mesh, Meshes, orbit_cameras, render_meshes
    >>> triangle = Meshes((Mesh(np.eye(3, dtype=np.float32), None, np.array([[0, 1, 2]], np.uint32)),))
    >>> image = render_meshes(triangle, orbit_cameras(triangle, width=16, height=12).cameras[0])
    >>> image.size, sorted(set(image.alpha.flat)) == [0, 1]
    ((16, 12), True)
    """

    def rendered(part: Camera) -> Image:
        return shade_surfaces(scene.meshes, part, lambda _, hits: surface_colours(hits, lit=lit), background)

    return supersampled(rendered, camera, samples)


def surface_colours(hits: Hits, *, lit: bool = True) -> npt.NDArray[np.float32]:
    """Return sRGB colours (m, 3) in 0..1. The only part that depends on the view is the headlight."""
    mesh = hits.mesh
    if mesh.texture is not None:
        if mesh.opaque is None or mesh.texture.shape[:2] == (1, 1):
            colours: npt.NDArray[Any] = bilinear(mesh.texture, hits.uvs)
        else:  # colours of holes must not show
            colours = nearest_texel(mesh.texture, hits.uvs) / np.float32(255)
        return colours if mesh.colours is None else colours * hits.mixed(mesh.colours)
    colours = np.full((len(hits.faces), 3), GREY) if mesh.colours is None else hits.mixed(mesh.colours)
    if not lit:
        return colours
    across = face_normals(mesh.positions, mesh.faces[hits.faces])
    length = np.linalg.norm(across, axis=1)
    facing = np.abs((across * hits.directions).sum(axis=1)) / np.where(length > 0, length, 1)
    return np.asarray(colours * (_AMBIENT + (1 - _AMBIENT) * facing[:, None]), np.float32)
