"""Mesh and photographs -> nerf2mesh's stage 1: diffuse texture, features, and the MLP that makes highlights of them."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.kernels.surface import specular, texels
from nerfbake.kernels.surface.normals import face_normals
from nerfbake.kernels.surface.raster import covered_texels, paint
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.stage1 import SpecularField, Stage1
from nerfbake.scene.views import Views
from nerfbake.stages._texels import Seen, see, texel_places
from nerfbake.stages.surface_to_charts import require_texture
from nerfbake.stages.views_to_texture import DiffuseProblem, mean_texels, rounded

# Chosen on the chair: fitted to half of its training photographs, measured on others of them.
_EPOCHS = 4  # passes over all pixels; five gain 0.2 dB over three, and lose more of it in an atlas
_DIFFUSE_STEPS = 4  # of conjugate gradients, each time the diffuse texture is improved
_STEPS = 300  # of the MLP in a pass
_RATES = (0.02, 0.002)  # of Adam, in the first and in the last step
_NORMALS = 0.2  # how far the first features, which are the surface's normals, are from grey
_DIM = 0.15  # the MLP starts with weights below 0, because a highlight is less than 1/2, which is what no weight gives
_EAGER = 0.7  # of a Gauss-Newton step of a feature
_KEPT = 0.3  # of the steepness of earlier passes: the MLP has changed since
_LEAST = 1e-3  # steepness that is added to a texel's
_SMOOTH = 0.3  # weight of a difference between neighbouring features, in mean steepnesses of a texel
_SMOOTH_STEPS = 3  # of conjugate gradients, from the features themselves
_LAST = 2  # rounds that fit the diffuse texture to the features of 8 bits
_SAMPLES = 2  # rays along an edge of a pixel, as photographs are averages over their pixels
_TEXEL_BYTES = 180  # while textures are fitted
_PIXEL_BYTES = 40


def fit_specular(mesh: Mesh, views: Views, *, edge: int = 2048, seed: int = 0) -> Stage1:
    """Return a scene as nerf2mesh's stage 1 has it, whose colours depend on the direction from which it is seen.

    A diffuse texture, three features a texel (both of edge x edge texels) and an MLP of 32 hidden units are fitted to
    the photographs together, as render_stage1() renders them: diffuse colours between texels, features of the nearest
    texel, and 2 x 2 rays a pixel. The features start as the surface's normals. Features and MLP improve in steps over a
    part of the pixels each (Gauss-Newton by coordinates, and Adam), in turns with the diffuse texture, which is the
    solution of a least-squares problem, as in fit_texture(). At the end, features are rounded to 8 bits, and the
    diffuse texture is fitted once more.

    The mesh needs texture coordinates in 0..1, such as unwrap_surface() makes. seed: of the MLP's first weights. Same
    bytes for any number of threads. Raises InvalidScene if no view shows the mesh, MemoryLimit.

    >>> from nerfbake import build_field, build_hull, build_views, fit_specular, orbit_cameras, render_field
    >>> from nerfbake import sample_n3tree, unwrap_surface
    >>> field = build_field(sample_n3tree(resolution=16))
    >>> (hull,) = build_hull(field, level=4).meshes
    >>> cameras = orbit_cameras(field, frames=3, width=24, height=24)
    >>> pictures = [render_field(field, camera, background=None).pixels for camera in cameras.cameras]
    >>> str(fit_specular(unwrap_surface(hull, edge=128), build_views(cameras, pictures), edge=128))[:26]
    'feature texture of 128x128'
    """
    require_texture(edge)
    with memory.scope():
        memory.hold(f"textures of {edge}x{edge} texels", _TEXEL_BYTES * edge * edge)
        with progress.part(0, 0.3):
            seen = see(mesh, views, edge, _SAMPLES)
        memory.hold("the colours of pixels", _PIXEL_BYTES * len(seen.targets))
        used = covered_texels(mesh.require_unwrapped(), mesh.faces, edge, edge)
        with progress.part(0.3, 1):
            look = _fit(seen, used, _normals(mesh, edge), np.random.default_rng(seed))
    field = SpecularField(look.features, look.w0, look.w1, used)
    return memory.kept(Stage1((field,), (replace(mesh, texture=look.diffuse, colours=None),)))


class _Look(NamedTuple):
    diffuse: npt.NDArray[np.uint8]
    features: npt.NDArray[np.uint8]
    w0: Singles
    w1: Singles


def _fit(seen: Seen, used: Bits, normals: Singles, random: np.random.Generator) -> _Look:
    weights = seen.cover * seen.cover
    problem = DiffuseProblem(seen, weights, used)
    features = np.asarray(0.5 + _NORMALS * normals, np.float32)
    mlp = _Mlp(random)
    shown = _shown(seen, features, mlp)
    diffuse = mean_texels(seen, weights, seen.targets - shown, used)
    steepness, rest = np.zeros_like(features), np.empty_like(seen.targets)  # rest: what the diffuse texture leaves over
    texels.residuals(*seen.lookups, diffuse, seen.targets, rest)
    for epoch in progress.each(range(_EPOCHS)):
        # Cut to 0..1: what a diffuse colour below 0 would take away is for the MLP to learn.
        diffuse = np.clip(problem.improved(diffuse, rest - shown, _DIFFUSE_STEPS), 0, 1)
        texels.residuals(*seen.lookups, diffuse, seen.targets, rest)
        steepness *= np.float32(_KEPT)
        _improve(seen, weights, rest, features, steepness, mlp, epoch)
        features = _smoothed(features, steepness, used)
        shown = _shown(seen, features, mlp) if epoch + 1 < _EPOCHS else shown
    rounded_features = rounded(texels.fill(features, used))
    shown = _shown(seen, np.asarray(rounded_features / np.float32(255), np.float32), mlp, exact=True)
    for turn in range(_LAST):
        if turn:
            texels.residuals(*seen.lookups, diffuse, seen.targets, rest)
        diffuse = np.clip(problem.improved(diffuse, rest - shown, _DIFFUSE_STEPS), 0, 1)
    return _Look(rounded(texels.fill(diffuse, used)), rounded_features, mlp.w0, mlp.w1)


class _Mlp:
    """The weights, which Adam improves (Kingma and Ba, 2014)."""

    def __init__(self, random: np.random.Generator) -> None:
        self.w0 = random.normal(0, 0.8, (6, specular.HIDDEN)).astype(np.float32)
        self.w1 = random.normal(-_DIM, _DIM, (specular.HIDDEN, 3)).astype(np.float32)
        self._first, self._second = (np.zeros((9, specular.HIDDEN)) for _ in range(2))
        self._steps = 0

    def step(self, slope: Floats, rate: float) -> None:
        """slope (9, HIDDEN): the direction that lowers the error, rows of w0 and columns of w1."""
        self._steps += 1
        self._first += 0.1 * (slope - self._first)
        self._second += 0.01 * (slope * slope - self._second)
        mean, size = self._first / (1 - 0.9**self._steps), self._second / (1 - 0.99**self._steps)
        change = (rate * mean / (np.sqrt(size) + 1e-10)).astype(np.float32)
        self.w0 += change[:6]
        self.w1 += change[6:].T


def _shown(seen: Seen, features: Singles, mlp: _Mlp, *, exact: bool = False) -> Singles:
    """(p, 3) the specular colours of the pixels."""
    out = np.empty_like(seen.targets)
    specular.specular(*seen.lookups, seen.directions, features, mlp.w0, mlp.w1, exact, out)
    return out


def _improve(
    seen: Seen, weights: Singles, rest: Singles, features: Singles, steepness: Singles, mlp: _Mlp, epoch: int
) -> None:
    """One pass over all pixels, in place. Each step takes blocks of pixels from all views."""
    count = -(-len(rest) // specular.BLOCK)
    steps = min(_STEPS, count)
    for step in range(steps):
        blocks = np.arange(step, count, steps)
        by_weight = np.empty((len(blocks), 9, specular.HIDDEN), np.float32)
        by_feature = np.zeros((len(blocks), specular.BLOCK, 6), np.float32)
        specular.slopes(
            blocks, *seen.lookups, seen.directions, weights, rest, features, mlp.w0, mlp.w1, by_weight, by_feature
        )
        share = (epoch * steps + step) / (_EPOCHS * steps)
        total = np.cumsum(by_weight, axis=0, dtype=np.float64)[-1]
        mlp.step(total / (specular.BLOCK * len(blocks)), _RATES[0] * (1 - share) + _RATES[1] * share)
        specular.move_features(blocks, *seen.lookups, by_feature, _EAGER, _LEAST, steepness, features)


def _smoothed(features: Singles, steepness: Singles, used: Bits) -> Singles:
    """Features near these where pixels determine them, and near their neighbours where pixels hardly do."""
    weight = np.asarray(steepness[..., 0] + steepness[..., 1] + steepness[..., 2])
    known = weight > 0
    strength = _SMOOTH * float(np.cumsum(weight[known], dtype=np.float64)[-1]) / max(int(known.sum()), 1)
    matrix = np.zeros((*used.shape, 5), np.float32)
    matrix[..., 0] = weight
    texels.smooth(used, strength, matrix)
    change = texels.solve(matrix, texels.roughness(features, used, strength), used, _SMOOTH_STEPS)
    return np.asarray(np.clip(features + change, 0, 1), np.float32)


def _normals(mesh: Mesh, edge: int) -> Singles:
    """(edge, edge, 3) the unit normal of the triangle at each texel, continued between charts."""
    across = face_normals(mesh.positions, mesh.faces)
    length = np.sqrt((across * across).sum(axis=1))
    normals = (across / np.where(length > 0, length, 1)[:, None]).astype(np.float32)
    out, known = np.zeros((edge, edge, 3), np.float32), np.zeros((edge, edge), np.bool_)
    paint(texel_places(mesh, edge), mesh.faces, normals, out, known)
    return texels.fill(out, known)
