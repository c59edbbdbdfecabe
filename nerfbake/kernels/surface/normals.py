"""Normals of the vertices of a mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt


def vertex_normals(positions: npt.NDArray[np.float32], faces: npt.NDArray[np.uint32]) -> npt.NDArray[np.float32]:
    """Return unit normals (v, 3): the mean of the triangles around a position, weighted by their areas.

    Vertices at exactly the same position, which texture coordinates have split, get the same normal. A position whose
    triangles have no area gets (0, 0, 1).
    """
    _, place = np.unique(positions, axis=0, return_inverse=True)
    place = place.reshape(-1)
    a, b, c = (positions[faces[:, corner]].astype(np.float64) for corner in range(3))
    across = np.cross(b - a, c - a)
    corners = place[faces.reshape(-1)]
    # bincount() adds in order, so the sums are the same on every CPU.
    sums = np.stack([np.bincount(corners, np.repeat(across[:, axis], 3), place.max() + 1) for axis in range(3)], axis=1)
    length = np.sqrt((sums * sums).sum(axis=1))
    flat = length == 0
    sums[flat], length[flat] = (0, 0, 1), 1
    return np.asarray(sums / length[:, None], np.float32)[place]
