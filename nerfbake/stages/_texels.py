"""Mesh and views -> the pixels in which the mesh is visible, with the texels that they show."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.surface import gbuffer, texels
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.views import Views

_BAND = 1 << 20  # rays at a time
_BAND_BYTES = 220  # per ray of a band, as in _surface
_RAY_BYTES, _PIXEL_BYTES = 8, 32  # of Seen


class Seen(NamedTuple):
    """The p pixels, in the order of the views, that are used and in which the mesh is visible.

    lookups     of their rays, in texel centres
    targets     (p, 3) sRGB in 0..1: what the visible part of the pixel should show on average
    cover       (p,) share of the pixel that the mesh covers, above 0
    directions  (p, 3) unit vectors from the camera through the centre of the pixel
    """

    lookups: texels.Lookups
    targets: Singles
    cover: Singles
    directions: Singles


def see(mesh: Mesh, views: Views, edge: int, samples: int) -> Seen:
    """Look at the mesh through all views, for a texture of edge x edge texels, with samples x samples rays a pixel.

    Raises InvalidScene if no view sees the mesh, MemoryLimit.
    """
    views.cameras.require_covered()
    places = texel_places(mesh, edge)
    bands: list[tuple[texels.Lookups, Singles, Singles, Singles]] = []
    with memory.scope():
        memory.hold("a band of rays", _BAND_BYTES * _BAND)
        for number in progress.each(range(len(views.pictures))):
            for band in _look(mesh, views, number, places, samples):
                # Counted twice: the parts, and all of them together.
                size = 2 * (_RAY_BYTES * len(band[0].at) + _PIXEL_BYTES * len(band[1]))
                memory.hold("what the views show of the mesh", size)
                bands.append(band)
        if not any(len(band[1]) for band in bands):
            found = "is not visible in any picture"
            raise InvalidScene(Problem("the mesh", found, "a mesh and photographs of the same scene, in one world"))
        counts = np.concatenate([np.diff(band[0].starts) for band in bands])
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        lookups = texels.Lookups(np.concatenate([band[0].at for band in bands]), starts)
        targets, cover, directions = (np.concatenate([band[k] for band in bands]) for k in range(1, 4))
    return Seen(lookups, targets, cover, directions)


def _look(
    mesh: Mesh, views: Views, number: int, places: Singles, samples: int
) -> Iterator[tuple[texels.Lookups, Singles, Singles, Singles]]:
    """Yield the lookups, targets, cover and directions of a view, a band of rows at a time."""
    camera = views.cameras.cameras[number]
    photograph, used = views.photograph(number), views.used(number)
    background = np.array(views.background, np.float32)
    rows = max(1, _BAND // (samples * samples * camera.width))
    for top in range(0, camera.height, rows):
        band = slice(top, min(top + rows, camera.height))
        across = slice(0, camera.width)
        part = camera.part(across, band, finer=samples)
        rays = part.rays()[1].reshape(part.height, part.width, 3)
        seen = gbuffer.gbuffer(mesh.positions, mesh.faces, camera.pose, rays)
        seen.triangle[np.repeat(np.repeat(~used[band], samples, axis=0), samples, axis=1)] = gbuffer.NONE
        lookups, pixels = texels.gather(seen.triangle, seen.weights, mesh.faces, places, samples)
        cover = (np.diff(lookups.starts) / np.float32(samples * samples)).astype(np.float32)
        directions = camera.part(across, band).rays()[1][pixels].astype(np.float32)
        shown = photograph[band].reshape(-1, 3)[pixels]
        rest = (1 - cover)[:, None] * background
        targets = np.clip((shown - rest) / cover[:, None], 0, 1)
        yield lookups, targets.astype(np.float32), cover, directions


def texel_places(mesh: Mesh, edge: int) -> Singles:
    """(v, 2) the vertices in texel centres. Raises InvalidScene for a mesh without coordinates in 0..1."""
    places = np.clip(mesh.require_unwrapped() * np.float32(edge) - np.float32(0.5), 0, edge - 1)
    return np.asarray(places, np.float32)
