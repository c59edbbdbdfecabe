"""Mesh -> the same surface with fewer triangles.

fast-simplification collapses edges one after another, so its result depends neither on threads nor on the CPU, but on
its version.
"""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Faces
from nerfbake.kernels.surface.triangles import compacted, turned_over, untangled
from nerfbake.scene.mesh import Mesh

_FACE_BYTES = 600  # per face, while edges are collapsed
_ROUNDS = 30  # of untangling


def simplify_surface(mesh: Mesh, *, triangles: int) -> Mesh:
    """Return the surface with at most about `triangles` triangles; a mesh that has so few already stays as it is.

    Texture coordinates, texture and colours are left out. Faces that the collapses turned over are untangled, and
    left out if that fails, as at the rim of a hole. Raises InvalidScene, MemoryLimit.
    Source: Garland and Heckbert, "Surface simplification using quadric error metrics" (1997).

    >>> from nerfbake import build_field, build_hull, sample_n3tree, simplify_surface
    >>> hull = build_hull(build_field(sample_n3tree(resolution=16))).meshes[0]
    >>> simpler = simplify_surface(hull, triangles=100)
    >>> len(simpler.faces) <= 100
    True
    """
    if triangles < 4:
        raise InvalidScene(Problem("triangles", f"are {triangles:,}", "4 or more"))
    positions, faces = mesh.positions, mesh.faces
    if len(faces) > triangles:
        import fast_simplification

        memory.require("simplifying the surface", _FACE_BYTES * len(faces))
        found = fast_simplification.simplify(
            positions.astype(np.float64), faces.astype(np.int32), target_count=triangles
        )
        positions, faces = found[0], found[1].astype(np.uint32)
    faces = _without_doubles(faces)
    straight = untangled(positions.astype(np.float64), faces, _ROUNDS).astype(np.float32)
    # A face that is left out changes the normals of its corners, and with them what counts as turned over.
    while (over := turned_over(straight.astype(np.float64), faces)).any():
        faces = faces[~over]
    if not len(faces):
        raise InvalidScene(Problem("the mesh", "has no face that looks outwards", "a surface"))
    positions, faces = compacted(straight, faces)
    return memory.kept(Mesh(positions, None, faces))


def _without_doubles(faces: Faces) -> Faces:
    """Drop triangles with two equal corners, and both of two with the same three: they are a sheet folded flat."""
    keys = np.sort(faces, axis=1)
    whole = (keys[:, 0] != keys[:, 1]) & (keys[:, 1] != keys[:, 2])
    faces, keys = faces[whole], keys[whole]
    _, first, times = np.unique(keys, axis=0, return_index=True, return_counts=True)
    return np.asarray(faces[np.sort(first[times == 1])])
