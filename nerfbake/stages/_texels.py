"""Mesh and views -> the pixels in which the mesh is visible, with the texels that they show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Ints, Singles
from nerfbake.kernels.surface import gbuffer, texels
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.views import Views

RAYS = 2  # along an edge of a pixel, as photographs are averages over their pixels
_BAND = 1 << 20  # rays at a time
_BAND_BYTES = 220  # per ray of a band, as in _surface
_RAY_BYTES, _PIXEL_BYTES = 8, 36  # of Seen


class Seen(NamedTuple):
    """The p pixels, in the order of the views, that are used and in which the mesh is visible.

    lookups     of their rays, in texel centres
    targets     (p, 3) sRGB in 0..1: what the visible part of the pixel should show on average
    cover       (p,) share of the pixel that the mesh covers, above 0
    facing      (p,) cosine between the ray and the surface
    directions  (p, 3) unit vectors from the camera through the centre of the pixel
    views       (v + 1,) the first pixel of each view
    """

    lookups: texels.Lookups
    targets: Singles
    cover: Singles
    facing: Singles
    directions: Singles
    views: Ints


def see(mesh: Mesh, views: Views, edge: int) -> Seen:
    """Look at the mesh through all views, for a texture of edge x edge texels.

    Raises InvalidScene if no view sees the mesh, MemoryLimit.
    """
    views.cameras.require_covered()
    places = np.clip(mesh.require_unwrapped() * np.float32(edge) - np.float32(0.5), 0, edge - 1)
    normals = _normals(mesh)
    bands: list[tuple[texels.Lookups, Singles, Singles, Singles, Singles]] = []
    ends = [0]
    with memory.scope():
        memory.hold("a band of rays", _BAND_BYTES * _BAND)
        for number, _ in progress.each(list(enumerate(views.cameras.cameras))):
            for band in _look(mesh, views, number, places, normals):
                # Counted twice: the parts, and all of them together.
                size = 2 * (_RAY_BYTES * len(band[0].at) + _PIXEL_BYTES * len(band[1]))
                memory.hold("what the views show of the mesh", size)
                bands.append(band)
            ends.append(ends[-1] + sum(len(band[1]) for band in bands[len(ends) - 1 :]))
        if not ends[-1]:
            found = "is not visible in any picture"
            raise InvalidScene(Problem("the mesh", found, "a mesh and photographs of the same scene, in one world"))
        counts = np.concatenate([np.diff(band[0].starts) for band in bands])
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        lookups = texels.Lookups(np.concatenate([band[0].at for band in bands]), starts)
        targets, cover, facing, directions = (np.concatenate([band[k] for band in bands]) for k in range(1, 5))
    return Seen(lookups, targets, cover, facing, directions, np.array(ends))


def _look(
    mesh: Mesh, views: Views, number: int, places: Singles, normals: Singles
) -> Iterator[tuple[texels.Lookups, Singles, Singles, Singles, Singles]]:
    """Yield the lookups, targets, cover, facing and directions of a view, a band of rows at a time."""
    camera = views.cameras.cameras[number]
    photograph, used = views.photograph(number), views.used(number)
    background = np.array(views.background, np.float32)
    rows = max(1, _BAND // (RAYS * RAYS * camera.width))
    for top in range(0, camera.height, rows):
        band = slice(top, min(top + rows, camera.height))
        across = slice(0, camera.width)
        part = camera.part(across, band, finer=RAYS)
        rays = part.rays()[1].reshape(part.height, part.width, 3)
        seen = gbuffer.gbuffer(mesh.positions, mesh.faces, camera.pose, rays)
        seen.triangle[np.repeat(np.repeat(~used[band], RAYS, axis=0), RAYS, axis=1)] = gbuffer.NONE
        lookups, pixels, first = texels.gather(seen.triangle, seen.weights, mesh.faces, places, RAYS)
        cover = (np.diff(lookups.starts) / np.float32(RAYS * RAYS)).astype(np.float32)
        directions = camera.part(across, band).rays()[1][pixels].astype(np.float32)
        facing = np.abs((normals[first] * directions).sum(axis=1))
        shown = photograph[band].reshape(-1, 3)[pixels]
        rest = (1 - cover)[:, None] * background
        targets = np.clip((shown - rest) / cover[:, None], 0, 1)
        yield lookups, targets.astype(np.float32), cover, facing, directions


def _normals(mesh: Mesh) -> Singles:
    """(t, 3) unit normals; 0 for triangles without area."""
    a, b, c = (mesh.positions[mesh.faces[:, corner]].astype(np.float64) for corner in range(3))
    across = np.cross(b - a, c - a)
    length = np.sqrt((across * across).sum(axis=1))
    return (across / np.where(length > 0, length, 1)[:, None]).astype(np.float32)
