"""Mesh -> the same surface with fewer triangles.

fast-simplification collapses edges one after another, so its result depends neither on threads nor on the CPU, but on
its version.
"""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Faces, Floats
from nerfbake.kernels.surface.triangles import compacted, turned_over, untangled
from nerfbake.scene.mesh import Mesh

_FACE_BYTES = 600  # per face, while edges are collapsed
# The library stops at an absolute error, in a coarse and in a tiny world too late or too early, and has an absolute
# smallest area. A ball of 1,500 triangles is 10 % off at a size of 0.02, 0.4 % at 2, 0.24 % from 20 to 2,000, and keeps
# 5,568 triangles at 200,000. So the longest edge of its box becomes 2^6 to 2^7 before the call.
_SIZE = 7
# How fast the allowed error grows. Where the library's own 7 stops at too many triangles, further calls start from its
# result, with new quadrics: a sheet of noise has 129 triangles instead of 50 after the first, and 50 after the second.
_AGGRESSIVENESS = 7.0, 10.0, 12.0
_ROUNDS = 30  # of untangling


def simplify_surface(mesh: Mesh, *, triangles: int) -> Mesh:
    """Return the surface with at most about `triangles` triangles; a mesh that has so few already stays as it is.

    A surface that would fold keeps more. The unit of the world does not matter: positions times a power of two give
    the same faces, and positions times that power. Texture coordinates, texture and colours are left out. Faces
    that the collapses turned over are untangled, and left out if that fails, as at the rim of a hole. Raises
    InvalidScene, MemoryLimit.
    Source: Garland and Heckbert, "Surface simplification using quadric error metrics" (1997).

    >>> from nerfbake import build_field, build_hull, sample_n3tree, simplify_surface
    >>> hull = build_hull(build_field(sample_n3tree(resolution=16))).meshes[0]
    >>> simpler = simplify_surface(hull, triangles=100)
    >>> len(simpler.faces) <= 100
    True
    """
    if triangles < 4:
        raise InvalidScene(Problem("triangles", f"are {triangles:,}", "4 or more"))
    positions, faces = mesh.positions.astype(np.float64), mesh.faces
    if len(faces) > triangles:
        memory.require("simplifying the surface", _FACE_BYTES * len(faces))
        positions, faces = _collapsed(positions, faces, triangles)
    faces = _without_doubles(faces)
    straight = untangled(positions, faces, _ROUNDS).astype(np.float32)
    # A face that is left out changes the normals of its corners, and with them what counts as turned over.
    while (over := turned_over(straight.astype(np.float64), faces)).any():
        faces = faces[~over]
    if not len(faces):
        raise InvalidScene(Problem("the mesh", "has no face that looks outwards", "a surface"))
    corners, faces = compacted(straight, faces)
    return memory.kept(Mesh(corners, None, faces))


def _collapsed(positions: Floats, faces: Faces, triangles: int) -> tuple[Floats, Faces]:
    """Collapse edges until `triangles` triangles are left, or more would fold the surface."""
    import fast_simplification

    corners = np.stack([positions.min(axis=0), positions.max(axis=0)])
    middle = corners.mean(axis=0)
    scale = np.ldexp(1.0, _SIZE - int(np.frexp((corners[1] - corners[0]).max())[1]))
    found = (positions - middle) * scale, faces.astype(np.int32)
    for aggressiveness in _AGGRESSIVENESS:
        if len(found[1]) > triangles:
            found = fast_simplification.simplify(*found, target_count=triangles, agg=aggressiveness)
    return found[0] / scale + middle, found[1].astype(np.uint32)


def _without_doubles(faces: Faces) -> Faces:
    """Drop triangles with two equal corners, and both of two with the same three: they are a sheet folded flat."""
    keys = np.sort(faces, axis=1)
    whole = (keys[:, 0] != keys[:, 1]) & (keys[:, 1] != keys[:, 2])
    faces, keys = faces[whole], keys[whole]
    _, first, times = np.unique(keys, axis=0, return_index=True, return_counts=True)
    return np.asarray(faces[np.sort(first[times == 1])])
