"""Meshes in front of a camera -> a picture, whatever gives them their colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.surface import gbuffer
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Mesh, joined_meshes

_PIXEL_BYTES = 220  # while a picture is made (195 measured, and a lens' 25)


@dataclass(frozen=True, eq=False)
class Hits:
    """The m pixels that one mesh fills.

    faces       (m,) which of its triangles
    weights     (m, 3) of the triangle's corners
    directions  (m, 3) unit, from the camera to the surface
    """

    mesh: Mesh
    faces: npt.NDArray[np.int64]
    weights: npt.NDArray[np.float32]
    directions: npt.NDArray[np.float64]

    def mixed(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """(m, k) of what its vertices have, (v, k)."""
        corners = values[self.mesh.faces[self.faces]]
        return np.asarray((self.weights[..., None] * corners).sum(axis=1), np.float32)

    @property
    def uvs(self) -> npt.NDArray[np.float32]:
        """(m, 2). Raises InvalidScene for a mesh without texture coordinates."""
        return self.mixed(self.mesh.require_uvs())


def paint(
    meshes: Sequence[Mesh],
    camera: Camera,
    colours: Callable[[int, Hits], npt.NDArray[np.float32]],
    background: tuple[float, float, float] | None,
) -> Image:
    """A picture whose alpha is 0 or 1. colours(i, hits): (m, 3) sRGB in 0..1 of what is seen of mesh i."""
    camera.require_memory(_PIXEL_BYTES)
    shape = (camera.height, camera.width)
    _, directions = camera.rays()
    positions, faces, first = joined_meshes(meshes)
    seen = gbuffer.gbuffer(positions, faces, camera.pose, directions.reshape(*shape, 3))
    triangle, weights = seen.triangle.reshape(-1), seen.weights.reshape(-1, 3)
    hit = seen.triangle != gbuffer.NONE
    colour = np.zeros((*shape, 3), np.float32)
    if background is not None:
        colour[~hit] = background
    filled = np.flatnonzero(triangle != gbuffer.NONE)
    owner = np.searchsorted(first, triangle[filled], side="right") - 1
    order = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[order], np.arange(len(meshes) + 1))
    for i, mesh in enumerate(meshes):
        pixels = filled[order[ends[i] : ends[i + 1]]]
        if not len(pixels):
            continue
        hits = Hits(mesh, triangle[pixels] - first[i], weights[pixels], directions[pixels])
        colour.reshape(-1, 3)[pixels] = colours(i, hits)
    depth = np.where(hit, seen.distance, 0).astype(np.float32)
    return Image(colour, hit.astype(np.float32), depth, background)
