"""Normals and areas of triangles, and vertices at one position, without numba, so that writing a mesh starts fast.

Faces (t, 3) are indices of vertices (v, 3).
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Faces, Floats, Ints, Singles


def face_normals(positions: npt.NDArray[Any], faces: Faces) -> Floats:
    """(t, 3) normals, as long as twice the area of the face."""
    a, b, c = (positions[faces[:, k]].astype(np.float64) for k in range(3))
    return np.asarray(np.cross(b - a, c - a), np.float64)


def doubled_areas(positions: npt.NDArray[Any], faces: Faces) -> Floats:
    """(t,) twice the area of each face."""
    normals = face_normals(positions, faces)
    return np.asarray(np.sqrt((normals * normals).sum(axis=1)))


def welded(positions: Singles) -> tuple[Ints, Ints]:
    """The first vertex (p,) at each position, and the number (v,) of each vertex's position.

    Texture coordinates split vertices. Positions are equal if all three coordinates are; -0 and 0 are the same.
    """
    places = np.ascontiguousarray(positions + np.float32(0))
    _, first, place = np.unique(places.view("V12").reshape(-1), return_index=True, return_inverse=True)
    return first, place


def welded_normals(positions: Singles, faces: Faces) -> Singles:
    """(v, 3) unit normals: the mean of the triangles around a position, weighted by their areas.

    Vertices at exactly the same position get the same normal. A position whose triangles have no area gets (0, 0, 1).
    """
    _, place = welded(positions)
    across, corners = face_normals(positions, faces), place[faces.reshape(-1)]
    # bincount() adds in order, so the sums are the same on every CPU.
    sums = np.stack([np.bincount(corners, np.repeat(across[:, axis], 3), place.max() + 1) for axis in range(3)], axis=1)
    length = np.sqrt((sums * sums).sum(axis=1))
    flat = length == 0
    sums[flat], length[flat] = (0, 0, 1), 1
    return np.asarray(sums / length[:, None], np.float32)[place]
