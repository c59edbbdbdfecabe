"""Rasterise meshes, with a callback that computes the colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.surface import gbuffer
from nerfbake.scene.camera import Camera
from nerfbake.scene.image import Image
from nerfbake.scene.mesh import Mesh, joined_meshes

_PIXEL_BYTES = 220  # per pixel while a picture is rendered (195 measured, plus 25 for a lens)


@dataclass(frozen=True, eq=False)
class Hits:
    """The m pixels in which one mesh is visible.

    faces       (m,) the triangle of each pixel
    weights     (m, 3) barycentric weights of the triangle's corners
    directions  (m, 3) unit vectors from the camera to the surface
    """

    mesh: Mesh
    faces: npt.NDArray[np.int64]
    weights: npt.NDArray[np.float32]
    directions: npt.NDArray[np.float64]

    def mixed(self, values: npt.NDArray[np.float32]) -> npt.NDArray[np.float32]:
        """Interpolate values of the mesh's vertices (v, k); returns (m, k)."""
        corners = values[self.mesh.faces[self.faces]]
        return np.asarray((self.weights[..., None] * corners).sum(axis=1), np.float32)

    @property
    def uvs(self) -> npt.NDArray[np.float32]:
        """Texture coordinates (m, 2). Raises InvalidScene for a mesh without them."""
        return self.mixed(self.mesh.require_uvs())


def shade_surfaces(
    meshes: Sequence[Mesh],
    camera: Camera,
    colours: Callable[[int, Hits], npt.NDArray[np.float32]],
    background: tuple[float, float, float] | None,
) -> Image:
    """Return a picture whose alpha is 0 or 1. colours(i, hits) returns the sRGB colours (m, 3) in 0..1 of mesh i."""
    seen = look_at_surfaces(meshes, camera, colours, channels=3)
    if background is not None:
        seen.values[seen.alpha == 0] = background
    return Image(seen.values, seen.alpha, seen.depth, background)


class SurfaceView(NamedTuple):
    """What the rays of a picture meet; values and depth are 0 where they meet nothing."""

    values: Singles  # (H, W, channels)
    alpha: Singles  # (H, W) 0 or 1
    depth: Singles  # (H, W) distance along the ray


def look_at_surfaces(
    meshes: Sequence[Mesh], camera: Camera, values: Callable[[int, Hits], Singles], *, channels: int
) -> SurfaceView:
    """Return what a camera sees. values(i, hits) returns the numbers (m, channels) of mesh i in these pixels."""
    camera.require_memory(_PIXEL_BYTES + 4 * max(channels - 3, 0))
    shape = (camera.height, camera.width)
    _, directions = camera.rays()
    positions, faces, first = joined_meshes(meshes)
    rays = directions.reshape(*shape, 3)
    seen = gbuffer.gbuffer(positions, faces, camera.pose, rays, _holes_of(meshes, first))
    triangle, weights = seen.triangle.reshape(-1), seen.weights.reshape(-1, 3)
    hit = seen.triangle != gbuffer.NONE
    found = np.zeros((*shape, channels), np.float32)
    filled = np.flatnonzero(triangle != gbuffer.NONE)
    owner = np.searchsorted(first, triangle[filled], side="right") - 1
    order = np.argsort(owner, kind="stable")
    ends = np.searchsorted(owner[order], np.arange(len(meshes) + 1))
    for i, mesh in enumerate(meshes):
        pixels = filled[order[ends[i] : ends[i + 1]]]
        if not len(pixels):
            continue
        hits = Hits(mesh, triangle[pixels] - first[i], weights[pixels], directions[pixels])
        found.reshape(-1, channels)[pixels] = values(i, hits)
    depth = np.where(hit, seen.distance, 0).astype(np.float32)
    return SurfaceView(found, hit.astype(np.float32), depth)


def _holes_of(meshes: Sequence[Mesh], first: Ints) -> gbuffer.Holes | None:
    """Return the holes of all meshes; None if there are none. first: each mesh's first face, and the end."""
    if all(mesh.opaque is None for mesh in meshes):
        return None
    uvs = [np.zeros((len(mesh.positions), 2), np.float32) if mesh.uvs is None else mesh.uvs for mesh in meshes]
    owner, texels = np.full(first[-1], -1, np.int32), []
    masks: list[tuple[int, int, int]] = []
    at = 0
    for i, mesh in enumerate(meshes):
        if mesh.opaque is not None:
            owner[first[i] : first[i + 1]] = len(masks)
            masks.append((at, *mesh.opaque.shape[:2]))
            texels.append(mesh.opaque.reshape(-1))
            at += mesh.opaque.size
    return gbuffer.Holes(np.concatenate(uvs), owner, np.array(masks, np.int64), np.concatenate(texels))
