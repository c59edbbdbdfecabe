"""Mesh and photographs -> the texture with which pictures of the mesh are most similar to the photographs."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Bits, Singles
from nerfbake.kernels.surface import texels
from nerfbake.kernels.surface.raster import covered_texels
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.views import Views
from nerfbake.stages._texels import Seen, see
from nerfbake.stages.surface_to_charts import require_texture

# Chosen on the chair: fitted to 90 of its training photographs, measured on the other 10.
_SMOOTH = 0.4  # weight of a difference between neighbouring texels, in pixels that show them: 30.8 dB, without 30.4
_DOUBT = 0.3  # colours that differ by more from the first guess count less, as of what is in front; 0.1: 0.05 dB less
_ROUNDS, _STEPS = 2, 6  # more rounds fit the noise of the training photographs: 0.3 dB less after six
_SEEN = 1e-3  # pixels: a texel that is shown less has the colour of its neighbours as its first guess
_TEXEL_BYTES = 110  # while a texture is fitted


def fit_texture(mesh: Mesh, views: Views, *, edge: int = 2048, samples: int = 2) -> Mesh:
    """Return the mesh with a texture (edge, edge, 3) uint8, sRGB, that is the same from all directions.

    One least-squares problem over all pixels of all views: the mean of a pixel's rays, each a bilinear lookup, should
    be the photograph's colour, and neighbouring texels should be similar. Pixels on the mesh's rim count by the
    square of their share that it covers, after the background has been subtracted. A pixel that differs much from the
    weighted mean of its texels counts less, so that what is in front of the mesh in one photograph does not stain the
    texture. Texels that no view shows, and those between charts, continue the colours around them.

    The mesh needs texture coordinates in 0..1, such as unwrap_surface() makes. samples: along each edge of a pixel, as
    in render_field(); one costs a quarter of four. Same bytes for any number of threads. Raises InvalidScene if no
    view shows the mesh, MemoryLimit.

    >>> from nerfbake import build_field, build_hull, build_views, fit_texture, orbit_cameras, render_field
    >>> from nerfbake import sample_n3tree, unwrap_surface
    >>> field = build_field(sample_n3tree(resolution=16))
    >>> (hull,) = build_hull(field, level=4).meshes
    >>> cameras = orbit_cameras(field, frames=3, width=24, height=24)
    >>> pictures = [render_field(field, camera, background=None).pixels for camera in cameras.cameras]
    >>> fit_texture(unwrap_surface(hull, edge=128), build_views(cameras, pictures), edge=128).texture.shape
    (128, 128, 3)
    """
    require_texture(edge)
    with memory.scope():
        memory.hold(f"a texture of {edge}x{edge} texels", _TEXEL_BYTES * edge * edge)
        seen = see(mesh, views, edge, samples)
        used = covered_texels(mesh.require_unwrapped(), mesh.faces, edge, edge)
        texture = rounded(_solve(seen, used))
    return memory.kept(replace(mesh, texture=texture, colours=None))


class DiffuseProblem:
    """Colours of texels from those of pixels, by least squares with similar neighbours.

    weights (p,) of the pixels. All colours are float32, and those of texels (edge, edge, 3) are not cut to 0..1.
    """

    def __init__(self, seen: Seen, weights: Singles, used: Bits) -> None:
        self._lookups, self._weights, self._used = seen.lookups, weights, used
        self._matrix = np.zeros((*used.shape, 5), np.float32)
        texels.couple(*seen.lookups, weights, self._matrix)
        texels.smooth(used, _SMOOTH, self._matrix)

    def improved(self, found: Singles, rest: Singles, steps: int) -> Singles:
        """Colours nearer to the solution, by steps from others, of which `rest` (p, 3) are the residuals."""
        right = texels.roughness(found, self._used, _SMOOTH)
        texels.spread(*self._lookups, self._weights, rest, right)
        return np.asarray(found + texels.solve(self._matrix, right, self._used, steps), np.float32)


def mean_texels(seen: Seen, weights: Singles, targets: Singles, used: Bits) -> Singles:
    """The weighted means of the pixels that show each texel, continued over texels that none shows."""
    total, found = np.zeros((*used.shape, 3), np.float32), np.zeros((*used.shape, 3), np.float32)
    texels.spread(*seen.lookups, weights, np.ones_like(targets), total)
    texels.spread(*seen.lookups, weights, targets, found)
    known = total[..., 0] > _SEEN
    return texels.fill(np.asarray(found / np.maximum(total, np.float32(_SEEN)), np.float32), known)


def first_guess(seen: Seen, weights: Singles, targets: Singles, used: Bits) -> tuple[Singles, Singles]:
    """mean_texels(), and its residuals (p, 3). Lowers, in place, the weights of pixels with large residuals."""
    found, rest = mean_texels(seen, weights, targets, used), np.empty_like(targets)
    texels.residuals(*seen.lookups, found, targets, rest)
    far = np.sqrt((rest * rest).sum(axis=1))
    weights *= np.minimum(1, np.float32(_DOUBT) / np.maximum(far, np.float32(_DOUBT)))
    return found, rest


def _solve(seen: Seen, used: Bits) -> Singles:
    weights = seen.cover * seen.cover
    found, rest = first_guess(seen, weights, seen.targets, used)
    problem = DiffuseProblem(seen, weights, used)
    for turn in range(_ROUNDS):
        if turn:
            texels.residuals(*seen.lookups, found, seen.targets, rest)
        found = problem.improved(found, rest, _STEPS)
    return texels.fill(found, used)


def rounded(colours: Singles) -> npt.NDArray[np.uint8]:
    return np.asarray(np.rint(np.clip(colours, 0, 1) * np.float32(255)), np.uint8)
