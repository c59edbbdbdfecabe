"""Connected parts, smoothing, normals and defects of triangle meshes.

Faces (t, 3) share vertices (v, 3). All sums run over the faces in order, so that every CPU returns the same bits.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Faces, Floats, Ints
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.surface.edges import mesh_edges
from nerfbake.kernels.surface.normals import face_normals

Number = TypeVar("Number", bound=np.floating[Any])

_LAMBDA, _MU = 0.5, -0.53  # Taubin's steps: the second undoes the shrinking of the first


def parts_of(faces: Faces, count: int) -> Ints:
    """(t,): the number of the connected part of each face, in order of the first face. count: of vertices."""
    parent = np.arange(count)
    _unite(faces, parent)
    _, first, part = np.unique(parent[faces[:, 0]], return_index=True, return_inverse=True)
    rank = np.empty(len(first), np.int64)
    rank[np.argsort(first, kind="stable")] = np.arange(len(first))
    return rank[part.reshape(-1)]


def compacted(positions: npt.NDArray[Number], faces: Faces) -> tuple[npt.NDArray[Number], Faces]:
    """The vertices that a face uses, in order, and the faces with their new numbers."""
    used = np.zeros(len(positions), bool)
    used[faces] = True
    return positions[used], (np.cumsum(used) - 1)[faces].astype(faces.dtype)


def rim_of(faces: Faces, count: int) -> Bits:
    """(count,): the vertices at an edge that does not have exactly one face on either side."""
    edges = mesh_edges(faces, count)
    open_ = (edges.times != 2) | (edges.balance != 0)
    rim = np.zeros(count, bool)
    rim[edges.low[open_]] = rim[edges.high[open_]] = True
    return rim


def smoothed(positions: Floats, faces: Faces, rounds: int) -> Floats:
    """Smooth the vertices without shrinking; those on the rim of a hole stay.

    Source: Taubin, "A signal processing approach to fair surface design" (1995), with equal weights.
    """
    fixed = rim_of(faces, len(positions))
    moved, mean = positions.copy(), np.empty_like(positions)
    degree = np.bincount(faces.reshape(-1), minlength=len(positions)).astype(np.float64)
    for turn in range(2 * rounds):
        _add_neighbours(moved, faces, mean)
        _step(moved, mean, degree, fixed, _LAMBDA if turn % 2 == 0 else _MU)
    return moved


def turned_over(positions: Floats, faces: Faces) -> Bits:
    """(t,): the faces that look away from the mean of their corners' normals, and those without an area."""
    around = vertex_normals(positions, faces)[faces].sum(axis=1)
    return np.asarray(~((face_normals(positions, faces) * around).sum(axis=1) > 0))


def untangled(positions: Floats, faces: Faces, rounds: int) -> Floats:
    """Move the corners of faces that are turned over to the mean of their neighbours, until no face is."""
    moved, mean = positions.copy(), np.empty_like(positions)
    degree = np.bincount(faces.reshape(-1), minlength=len(positions)).astype(np.float64)
    for _ in range(rounds):
        over = turned_over(moved, faces)
        if not over.any():
            break
        fixed = np.ones(len(positions), bool)
        fixed[faces[over]] = False
        _add_neighbours(moved, faces, mean)
        _step(moved, mean, degree, fixed, _LAMBDA)
    return moved


def vertex_normals(positions: Floats, faces: Faces) -> Floats:
    """(v, 3) unit normals: the sums of the faces' normals, weighted by area; 0 where the sum is 0."""
    total = np.zeros((len(positions), 3))
    _add_to_corners(face_normals(positions, faces), faces, total)
    size = np.sqrt((total * total).sum(axis=1))
    return np.asarray(np.divide(total, size[:, None], out=np.zeros_like(total), where=size[:, None] > 0))


@compiled()
def _root(parent: Ints, v: int) -> int:
    while parent[v] != v:
        parent[v] = parent[parent[v]]
        v = parent[v]
    return v


@compiled()
def _unite(faces: Faces, parent: Ints) -> None:
    """Union by the lower number, and in the end each vertex's root."""
    for f in range(len(faces)):
        a = _root(parent, faces[f, 0])
        for corner in range(1, 3):
            b = _root(parent, faces[f, corner])
            low, high = min(a, b), max(a, b)
            parent[high] = low
            a = low
    for v in range(len(parent)):
        parent[v] = _root(parent, v)


@compiled()
def _add_neighbours(positions: Floats, faces: Faces, total: Floats) -> None:
    """Add up the neighbours of each vertex; around a closed fan, each one is the next corner of one face."""
    total[:] = 0
    for f in range(len(faces)):
        for corner in range(3):
            a, b = faces[f, corner], faces[f, (corner + 1) % 3]
            for axis in range(3):
                total[a, axis] += positions[b, axis]


@compiled()
def _step(positions: Floats, total: Floats, degree: Floats, fixed: Bits, share: float) -> None:
    for v in range(len(positions)):
        if not fixed[v] and degree[v] > 0:
            for axis in range(3):
                positions[v, axis] += share * (total[v, axis] / degree[v] - positions[v, axis])


@compiled()
def _add_to_corners(values: Floats, faces: Faces, total: Floats) -> None:
    for f in range(len(faces)):
        for corner in range(3):
            for axis in range(3):
                total[faces[f, corner], axis] += values[f, axis]
