"""Radiance field, opaque meshes and camera -> a picture of both."""

from __future__ import annotations

from typing import get_args

import numpy as np

from nerfbake.errors import InvalidScene, Problem
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import WHITE, Image
from nerfbake.scene.mesh import Composite, Meshes
from nerfbake.scene.octree import Lookup
from nerfbake.scene.radiance_field import RadianceField, require_field
from nerfbake.stages._supersampled import supersampled
from nerfbake.stages.field_to_image import RenderOptions
from nerfbake.stages.meshes_to_image import render_meshes
from nerfbake.stages.renderers import KERNELS, Renderer


def render_field_and_meshes(
    field: RadianceField,
    meshes: Meshes,
    camera: Camera,
    *,
    how: Composite = "stop",
    background: tuple[float, float, float] | None = WHITE,
    transmittance_cut: float = 1e-4,
    lookup: Lookup = "nearest",
    samples: int = 1,
    render: Renderer = KERNELS,
) -> Image:
    """Render a field with opaque meshes in the same world coordinates. For the other options see render_field().

    `how` selects how the two are combined:

    stop   rays end at the mesh, which is visible through the part of the field in front of it
    ztest  the field is rendered without the mesh; where its expected depth is nearer than the mesh, the whole field is
           composited over the mesh, elsewhere only the mesh is visible. Suitable for existing pictures with depth;
           wrong where a ray crosses parts of the field on both sides of the mesh

    With samples x samples rays per pixel, each ray ends or is tested separately, and the pixel is their mean as in
    render_field(), also at the edges of a mesh. render: renders the field. Source: TR-24-01 (docs/sources.md),
    section 5.2.

    >>> import numpy as np
    >>> from nerfbake import Mesh, Meshes, build_field, orbit_cameras, render_field_and_meshes, sample_n3tree
    >>> field = build_field(sample_n3tree(resolution=8))
    >>> triangle = Mesh(np.eye(3, dtype=np.float32), None, np.array([[0, 1, 2]], np.uint32))
    >>> (view,) = orbit_cameras(field, width=16, height=12).cameras
    >>> render_field_and_meshes(field, Meshes((triangle,)), view).size
    (16, 12)
    """
    if how not in get_args(Composite):
        raise InvalidScene(Problem("composite", f"is {how!r}", ", ".join(get_args(Composite))))
    require_field(field)
    options: RenderOptions = {"background": None, "transmittance_cut": transmittance_cut, "lookup": lookup}
    image = supersampled(lambda part: _rendered(field, meshes, part, how, options, render), camera, samples)
    return image if background is None else image.over(background)


def _rendered(
    field: RadianceField, meshes: Meshes, camera: Camera, how: Composite, options: RenderOptions, render: Renderer
) -> Image:
    """Render with one ray per pixel over a transparent background."""
    mesh = render_meshes(meshes, camera, background=None)
    solid = mesh.alpha > 0
    stop = np.where(solid, mesh.depth, np.inf).astype(np.float64) if how == "stop" else None
    fog = render(field, camera, stop=stop, **options)
    hidden = solid & (fog.depth >= mesh.depth) & (how == "ztest")
    near = np.where(hidden, 0, fog.alpha).astype(np.float32)
    left = (1 - near) * mesh.alpha
    alpha = near + left
    colour = np.where(hidden[..., None], 0, fog.colour) + left[..., None] * mesh.colour
    far = near * fog.depth + left * mesh.depth
    depth = np.divide(far, alpha, out=np.zeros_like(far), where=alpha > 0)
    return Image(colour.astype(np.float32), alpha, depth, None)
