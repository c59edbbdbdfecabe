"""nerf2mesh stage 1 or MobileNeRF -> meshes whose colours do not depend on the direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from nerfbake import memory, progress
from nerfbake.kernels.cluster.colours import codes_of, colours_of
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.surface import mlp
from nerfbake.kernels.surface.texture import bilinear
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.scene.stage1 import SpecularField, Stage1
from nerfbake.stages.stage1_to_image import surfaces

_TEXEL_BYTES, _COLOUR_BYTES = 60, 140  # per texel of the texture, and per distinct colour of the features


def colour_meshes(stage1: Stage1, *, directions: int = 100) -> Meshes:
    """Return the meshes with the mean colour of each texel over evenly spread directions as their texture.

    The texture has the size of the features. Texels that no triangle shows are black. Raises InvalidScene if a mesh or
    its texture is missing, MemoryLimit.

    >>> from nerfbake import colour_meshes, sample_stage1
    >>> print(colour_meshes(sample_stage1(resolution=16)))
    mesh of 9,216 triangles over 4,753 vertices
    """
    parts = list(zip(surfaces(stage1), stage1.fields, strict=True))
    return memory.kept(Meshes(tuple(_flatten(*part, directions) for part in progress.each(parts))))


def _flatten(mesh: Mesh, field: SpecularField, directions: int) -> Mesh:
    H, W, _ = field.features.shape
    memory.require("the mean colours", _TEXEL_BYTES * H * W)
    codes, place = np.unique(codes_of(field.features[field.used]), return_inverse=True)
    memory.require(f"{len(codes):,} colours", _COLOUR_BYTES * len(codes))
    basis = np.repeat(np.eye(3, dtype=np.float32), directions, axis=0) / np.float32(directions)
    split = mlp.split_layers(fibonacci(directions), *field.mlp)
    means = mlp.project(colours_of(codes, field.channels) / 255, split, basis, np.zeros(3, np.float32))
    colour = _diffuse(mesh, H, W)
    colour[field.used] += means[place]
    colour[~field.used] = 0
    texture = np.rint(255 * np.clip(colour, 0, 1)).astype(np.uint8)
    return replace(mesh, texture=texture)


def _diffuse(mesh: Mesh, H: int, W: int) -> npt.NDArray[np.float32]:
    """Return the diffuse texture at the centres of H x W texels, (H, W, 3) in 0..1."""
    assert mesh.texture is not None
    if mesh.texture.shape[:2] == (H, W):
        return np.asarray(mesh.texture / np.float32(255), np.float32)
    v, u = np.meshgrid((np.arange(H) + 0.5) / H, (np.arange(W) + 0.5) / W, indexing="ij")
    return bilinear(mesh.texture, np.stack([u, v], axis=-1).reshape(-1, 2)).reshape(H, W, 3)
