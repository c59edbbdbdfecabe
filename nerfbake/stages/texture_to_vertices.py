"""Textured mesh -> a mesh with colours at its vertices."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.surface.normals import welded
from nerfbake.kernels.surface.texture import bilinear
from nerfbake.scene.mesh import Mesh

_VERTEX_BYTES = 400  # per vertex, while equal places are found


def colour_vertices(mesh: Mesh) -> Mesh:
    """Return the mesh with the texture's colours at its vertices, without texture and texture coordinates.

    Vertices at exactly the same position, which texture coordinates have split, become one, with the mean of their
    colours. The triangles keep their order. Raises InvalidScene for a mesh without a texture.

    >>> from nerfbake import colour_vertices, sample_stage1
    >>> (torus,) = sample_stage1(resolution=16).meshes
    >>> coloured = colour_vertices(torus)
    >>> coloured.texture is None, coloured.colours.shape == coloured.positions.shape
    (True, True)
    """
    if mesh.texture is None:
        raise InvalidScene(Problem("the mesh", "has no texture", "a texture, for the colours of its vertices"))
    memory.require("the colours of the vertices", _VERTEX_BYTES * len(mesh.positions))
    colours = bilinear(mesh.texture, mesh.require_uvs())
    first, place = welded(mesh.positions)
    count = np.bincount(place)
    # bincount() adds in order, so the sums are the same on every CPU.
    means = np.stack([np.bincount(place, colours[:, channel]) / count for channel in range(3)], axis=1)
    faces = place[mesh.faces].astype(np.uint32)
    return memory.kept(Mesh(mesh.positions[first], None, faces, colours=means.clip(0, 1).astype(np.float32)))
