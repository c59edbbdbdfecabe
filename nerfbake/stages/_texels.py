"""Mesh and views -> the pixels in which the mesh is visible, with the texels that they show."""

from __future__ import annotations

from functools import partial
from typing import NamedTuple

import numpy as np

from nerfbake import memory, progress
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.parallel import cores, in_order
from nerfbake.kernels.surface import gbuffer, texels
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.views import Views
from nerfbake.stages._ray_targets import reduced_view

_BAND = 1 << 20  # rays of a view at a time
_BAND_BYTES = 220  # per ray of a band, as in _surface
_RAY_BYTES, _PIXEL_BYTES = 8, 32  # of Seen
_MOST_PIXELS = 20_000_000  # that show an object; pictures with more of them are reduced, or memory exceeds 2 GB


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

    Pictures that show more than 20 million pixels of an object are reduced by a whole factor first. Raises InvalidScene
    if no view sees the mesh, MemoryLimit.
    """
    views.cameras.require_covered()
    places, scale = texel_places(mesh, edge), _scale(views)
    bands: list[tuple[texels.Lookups, Singles, Singles, Singles]] = []
    with memory.scope():
        pixels = max(camera.width * camera.height for camera in views.cameras.cameras) // (scale * scale)
        rays = min(_BAND, samples * samples * max(pixels, 1))
        # Two views at once, or more if they are small.
        most = min(cores(), max(2, _BAND // rays), max(1, memory.left() // (4 * _BAND_BYTES * rays)))
        memory.hold("bands of rays", _BAND_BYTES * rays * most)
        numbers = range(len(views.pictures))
        looks = in_order((partial(_look, mesh, views, k, scale, places, samples) for k in numbers), most=most)
        for _ in progress.each(numbers):
            for band in next(looks):
                # Counted 1.5 times: the parts, and at most half of them put together before their parts are dropped.
                size = 3 * (_RAY_BYTES * len(band[0].at) + _PIXEL_BYTES * len(band[1])) // 2
                memory.hold("what the views show of the mesh", size)
                bands.append(band)
        if not any(len(band[1]) for band in bands):
            found = "is not visible in any picture"
            raise InvalidScene(Problem("the mesh", found, "a mesh and photographs of the same scene, in one world"))
        counts = np.concatenate([np.diff(band[0].starts) for band in bands])
        starts = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
        # Column by column: the parts of one are dropped before the next is put together.
        columns = [[lookups.at, *others] for lookups, *others in bands]
        bands.clear()
        at, targets, cover, directions = (np.concatenate([band.pop(0) for band in columns]) for _ in range(4))
        lookups = texels.Lookups(at, starts)
    return Seen(lookups, targets, cover, directions)


def _scale(views: Views) -> int:
    """Return the factor by which pictures are reduced."""
    shown = sum(int(np.count_nonzero(~views.behind(number))) for number in range(len(views.pictures)))
    scale = 1
    while shown > _MOST_PIXELS * scale * scale:
        scale += 1
    return scale


def _look(
    mesh: Mesh, views: Views, number: int, scale: int, places: Singles, samples: int
) -> list[tuple[texels.Lookups, Singles, Singles, Singles]]:
    """Return the lookups, targets, cover and directions of a view, for each band of rows."""
    bands = []
    camera, image = reduced_view(views, number, scale)
    photograph, alpha = image[..., :3], image[..., 3]
    used = alpha >= 1 if views.scenery and views.masked else np.ones(alpha.shape, bool)
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
        bands.append((lookups, targets.astype(np.float32), cover, directions))
    return bands


def texel_places(mesh: Mesh, edge: int) -> Singles:
    """(v, 2) the vertices in texel centres. Raises InvalidScene for a mesh without coordinates in 0..1."""
    places = np.clip(mesh.require_unwrapped() * np.float32(edge) - np.float32(0.5), 0, edge - 1)
    return np.asarray(places, np.float32)
