"""A glossy torus -> a nerf2mesh stage-1 scene with mesh, textures and a fitted MLP, for demos, tests and benchmarks."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import sigmoid, sine_cosine
from nerfbake.kernels.maths.linear import product
from nerfbake.kernels.surface.raster import covered_texels
from nerfbake.scene.mesh import Mesh
from nerfbake.scene.stage1 import SpecularField, Stage1

HIDDEN = 32  # hidden units, as in nerf2mesh
RADIUS, THICKNESS = 0.62, 0.27  # of the torus, in world units; its axis is y, which is up
_MARGIN = 0.04  # width of the texture's border that no triangle uses, as a fraction of the texture
_RINGS, _SIDES = 96, 48
_LIGHT = np.array([0.42, 0.8, -0.43])  # unit, towards the light
_STEPS, _BATCH, _RATE = 1000, 1024, 0.03
_TEXEL_BYTES = 176  # per texel while the textures are computed (172 measured)


def sample_stage1(*, resolution: int = 512, seed: int = 0) -> Stage1:
    """Return a torus whose features are its normals and gloss, and an MLP for its highlight and sheen.

    resolution: texels along the textures' edges, 16 to 8192. The same arguments give the same bytes. Raises
    InvalidScene, MemoryLimit.

    >>> from nerfbake import sample_stage1
    >>> print(sample_stage1(resolution=16))
    feature texture of 16x16, 256 texels used, MLP 6-32-3
    """
    if not 16 <= resolution <= 8192:
        raise InvalidScene(Problem("resolution", f"is {resolution}", "16 to 8192 texels"))
    memory.require(f"textures of {resolution}x{resolution}", _TEXEL_BYTES * resolution**2)
    at = (np.arange(resolution) + 0.5) / resolution
    v, u = np.meshgrid(at, at, indexing="ij")
    _, normals = _torus(u, v)
    gloss = 0.55 + 0.45 * np.sign(sine_cosine(14 * np.pi * u)[0] * sine_cosine(7 * np.pi * v)[0])
    features = _features(normals, gloss)
    mesh = _mesh()
    used = covered_texels(mesh.require_uvs(), mesh.faces, resolution, resolution)
    features[~used] = 0
    base = np.array([0.55, 0.13, 0.1]) + np.array([0.12, 0.1, 0.08]) * gloss[..., None]
    lit = base * (0.45 + 0.55 * np.maximum((normals * _LIGHT).sum(axis=-1), 0))[..., None]
    diffuse = np.where(used[..., None], np.rint(255 * lit), 0).astype(np.uint8)
    w0, w1 = (weights.copy() for weights in _fit(seed))
    return memory.kept(Stage1((SpecularField(features, w0, w1, used),), (replace(mesh, texture=diffuse),)))


def _torus(u: Floats, v: Floats) -> tuple[Floats, Floats]:
    """Return points and unit normals (..., 3) at texture coordinates: u around the axis, v around the tube."""
    around, across = ((2 * np.pi * (t - _MARGIN) / (1 - 2 * _MARGIN)) for t in (u, v))
    (sine, cosine), (up, flat) = sine_cosine(around), sine_cosine(across)
    normals = np.stack([cosine * flat, up, sine * flat], axis=-1)
    middle = np.stack([cosine, np.zeros_like(around), sine], axis=-1)
    return RADIUS * middle + THICKNESS * normals, normals


def _mesh() -> Mesh:
    u, v = (_MARGIN + (1 - 2 * _MARGIN) * np.linspace(0, 1, n + 1) for n in (_RINGS, _SIDES))
    v, u = np.meshgrid(v, u, indexing="xy")
    points, _ = _torus(u, v)
    corner = np.arange(_RINGS)[:, None] * (_SIDES + 1) + np.arange(_SIDES)
    near, far = corner, corner + _SIDES + 1
    faces = np.stack([near, near + 1, far + 1, near, far + 1, far], axis=-1).reshape(-1, 3)
    uvs = np.stack([u, v], axis=-1).reshape(-1, 2)
    return Mesh(points.reshape(-1, 3).astype(np.float32), uvs.astype(np.float32), faces.astype(np.uint32))


def _features(normals: Floats, gloss: Floats) -> npt.NDArray[np.uint8]:
    """Return features (..., 3) uint8: the normal, which is shorter where the surface is matt."""
    return np.rint(255 * (0.5 + 0.5 * normals * gloss[..., None])).astype(np.uint8)


def _look(features: Floats, directions: Floats) -> Floats:
    """Return the highlight of the light plus a bluish sheen at grazing angles (m, 3) in 0..1.

    features (m, 3) in 0..1, directions (m, 3) unit vectors.
    """
    bent = 2 * features - 1
    gloss = np.linalg.norm(bent, axis=1, keepdims=True)
    normal = bent / np.maximum(gloss, 1e-6)
    facing = -(directions * normal).sum(axis=1, keepdims=True)
    mirrored = directions + 2 * facing * normal
    spot = np.maximum((mirrored * _LIGHT).sum(axis=1), 0)[:, None]
    spot, sheen = (spot * spot) * (spot * spot), 1 - np.abs(facing)
    sheen = sheen * sheen * sheen
    return np.asarray(0.02 + gloss * (0.6 * spot * [1, 0.93, 0.8] + 0.2 * sheen * [0.6, 0.8, 1]))


@lru_cache(maxsize=4)  # a second; the textures of a small sample take a hundredth of it
def _fit(seed: int) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Fit the MLP's weights by Adam (Kingma and Ba, 2014) to random normals, glosses and directions."""
    random = np.random.default_rng(seed)
    weights = [random.normal(0, 1, (6, HIDDEN)), random.normal(0, 0.3, (HIDDEN, 3))]
    first, second = ([np.zeros(w.shape) for w in weights] for _ in range(2))
    for step in range(1, _STEPS + 1):
        normals, directions = (_unit(random.normal(size=(_BATCH, 3))) for _ in range(2))
        directions *= -np.sign((directions * normals).sum(axis=1, keepdims=True))  # visible from outside only
        features = 0.5 + 0.5 * normals * random.choice([0.1, 1.0], (_BATCH, 1))
        inputs = np.concatenate([directions, features], axis=1)
        hidden = np.maximum(product(inputs, weights[0]), 0)
        shown = sigmoid(product(hidden, weights[1]))
        slope = (shown - _look(features, directions)) * shown * (1 - shown) / _BATCH
        back = product(slope, weights[1].T) * (hidden > 0)
        gradients = [product(inputs.T, back), product(hidden.T, slope)]
        for w, gradient, m, s in zip(weights, gradients, first, second, strict=True):
            m += 0.1 * (gradient - m)
            s += 0.001 * (gradient**2 - s)
            w -= _RATE * (m / (1 - 0.9**step)) / (np.sqrt(s / (1 - 0.999**step)) + 1e-12)
    return weights[0].astype(np.float32), weights[1].astype(np.float32)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
