"""Marching cubes over bricks of samples: triangles between samples below a level and samples above it.

The table is made here, not copied: on each face of a cube, segments separate the corners inside from those outside.
Where a face has two inside corners across, they are separated, too. Both cubes of a face see the same four corners,
so their segments coincide, and the surface is closed. The segments of a cube form loops, which are cut into triangles
such that no cut lies in a face.
Source: Lorensen and Cline, "Marching cubes" (1987); the rule for ambiguous faces as in Montani et al. (1994).
"""

from __future__ import annotations

from functools import lru_cache
from itertools import product
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.kernels.arrays import Coords, Floats, Ints, Singles
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.surface.samples import BITS, CUBE, Top, place_of, sample_at, slot_of

_LEAST = 1e-3  # of an edge: how near a vertex may come to a sample, so that no triangle has two equal corners
_AXES = ((4, 2, 1), (2, 1, 4), (1, 4, 2))  # corner bits: an axis, and the two others in cyclic order

# Edge e = 4 axis + 2 b + c starts at the corner with bits b and c along the next two axes.
STARTS = np.array([b * u + c * w for _, u, w in _AXES for b, c in product((0, 1), repeat=2)], np.int64)


class CubeTable(NamedTuple):
    """sizes (256,): triangles of each case, and their edges (256, most, 3). Case: bit k for corner k = 4x + 2y + z."""

    sizes: Ints
    edges: npt.NDArray[np.int8]


def _edge(a: int, b: int) -> int:
    """The number of the edge between two corners."""
    axis = _AXES[[4, 2, 1].index(a ^ b)]
    low = min(a, b)
    number = [4, 2, 1].index(a ^ b)
    return 4 * number + 2 * bool(low & axis[1]) + bool(low & axis[2])


def _faces() -> list[tuple[int, int, int, int]]:
    """The corners of each face, counter-clockwise seen from outside the cube."""
    faces = []
    for axis, u, w in _AXES:
        faces.append((axis, axis | u, axis | u | w, axis | w))
        faces.append((0, w, u | w, u))
    return faces


def _loops(case: int) -> list[list[int]]:
    """The closed loops of edges between inside and outside corners, counter-clockwise seen from outside."""
    follow: dict[int, int] = {}
    for face in _faces():
        inside = [bool(case >> corner & 1) for corner in face]
        for k in range(4):
            # A run of inside corners from k to j, seen from outside the cube, counter-clockwise.
            if inside[k] and not inside[k - 1]:
                j = k
                while inside[(j + 1) % 4]:
                    j += 1
                enter = _edge(face[k - 1], face[k])
                leave = _edge(face[j % 4], face[(j + 1) % 4])
                follow[enter] = leave
    loops = []
    while follow:
        first = next(iter(follow))
        loop, at = [first], follow.pop(first)
        while at != first:
            loop.append(at)
            at = follow.pop(at)
        loops.append(loop)
    return loops


def _faces_of(edge: int) -> set[int]:
    start = int(STARTS[edge])
    ends = {start, start | (4, 2, 1)[edge // 4]}
    return {number for number, face in enumerate(_faces()) if ends <= set(face)}


def _cut(loop: list[int]) -> list[tuple[int, int, int]] | None:
    """Triangles of a loop whose inner edges lie in no face of the cube; None if there are none."""
    if len(loop) == 3:
        return [(loop[0], loop[1], loop[2])]
    for k in range(len(loop)):
        before, here, after = loop[k - 1], loop[k], loop[(k + 1) % len(loop)]
        if _faces_of(before) & _faces_of(after):
            continue
        rest = _cut([edge for edge in loop if edge != here])
        if rest is not None:
            return [(before, here, after), *rest]
    return None


@lru_cache(maxsize=1)
def cube_table() -> CubeTable:
    """The triangles of all 256 cases."""
    cases = []
    for case in range(256):
        triangles = []
        for loop in _loops(case):
            cut = _cut(loop)
            assert cut is not None, case
            triangles += cut
        cases.append(triangles)
    edges = np.zeros((256, max(map(len, cases)), 3), np.int8)
    for case, triangles in enumerate(cases):
        for k, triangle in enumerate(triangles):
            edges[case, k] = triangle
    return CubeTable(np.array(list(map(len, cases)), np.int64), edges)


def march_cubes(top: Top, places: Coords, values: Singles, level: float) -> tuple[Floats, npt.NDArray[np.int32]]:
    """Positions (v, 3) in the lattice, and triangles (t, 3), around the samples below a level.

    Triangles are counter-clockwise seen from the samples above it, if the lattice's axes are right-handed. Cubes that
    miss a sample have none, so the surface has holes there.
    """
    table = cube_table()
    counts = np.zeros((len(places), 2), np.int64)
    first = np.empty((len(places), CUBE), np.int32)
    _count(top, places, values, level, table.sizes, first, counts)
    ends = np.cumsum(counts, axis=0)
    vertices, triangles = (int(end) for end in ends[-1]) if len(places) else (0, 0)
    memory.require("the surface", 40 * vertices + 24 * triangles)
    starts = ends - counts
    positions, faces = np.empty((vertices, 3)), np.empty((triangles, 3), np.int32)
    first += starts[:, :1].astype(np.int32)
    _fill(top, places, values, level, table, STARTS, first, starts, positions, faces)
    return positions, faces


@compiled(merged=True)
def _case(top: Top, values: Singles, level: float, x: int, y: int, z: int) -> int:
    """The case of the cube above a sample; 0 if one of its samples is missing."""
    case = 0
    for corner in range(8):
        value = sample_at(top, values, x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1))
        if value == np.inf:
            return 0
        case |= int(value < level) << corner
    return case


@compiled(merged=True)
def _crossed(top: Top, values: Singles, level: float, x: int, y: int, z: int) -> int:
    """A bit for each axis along which the edge from a sample to the next one crosses the level: 4, 2, 1."""
    here = sample_at(top, values, x, y, z)
    found = 0
    for axis in range(3):
        there = sample_at(top, values, x + (axis == 0), y + (axis == 1), z + (axis == 2))
        if there != np.inf and (here < level) != (there < level):
            found |= 4 >> axis
    return found


@on_every_core
@compiled()
def _count(
    core: int,
    cores: int,
    top: Top,
    places: Coords,
    values: Singles,
    level: float,
    per_case: Ints,
    first: npt.NDArray[np.int32],
    counts: Ints,
) -> None:
    """Count the vertices and the triangles of each brick, and number the vertices of each sample in its brick."""
    top, places, values, per_case, first, counts = borrowed((top, places, values, per_case, first, counts))
    for brick in range(core, len(places), cores):
        vertices, triangles = 0, 0
        for cell in range(CUBE):
            x, y, z = place_of(places, brick, cell)
            first[brick, cell] = vertices
            crossed = _crossed(top, values, level, x, y, z)
            vertices += (crossed >> 2) + (crossed >> 1 & 1) + (crossed & 1)
            triangles += per_case[_case(top, values, level, x, y, z)]
        counts[brick, 0], counts[brick, 1] = vertices, triangles


@on_every_core
@compiled()
def _fill(
    core: int,
    cores: int,
    top: Top,
    places: Coords,
    values: Singles,
    level: float,
    table: CubeTable,
    starts_of: Ints,
    first: npt.NDArray[np.int32],
    starts: Ints,
    positions: Floats,
    faces: npt.NDArray[np.int32],
) -> None:
    top, places, values, table, starts_of, first, starts, positions, faces = borrowed(
        (top, places, values, table, starts_of, first, starts, positions, faces)
    )
    for brick in range(core, len(places), cores):
        triangle = starts[brick, 1]
        for cell in range(CUBE):
            x, y, z = place_of(places, brick, cell)
            vertex, here = first[brick, cell], sample_at(top, values, x, y, z)
            for axis in range(3):
                there = sample_at(top, values, x + (axis == 0), y + (axis == 1), z + (axis == 2))
                if there != np.inf and (here < level) != (there < level):
                    share = min(max((level - here) / (there - here), _LEAST), 1 - _LEAST)
                    positions[vertex, 0] = x + share * (axis == 0)
                    positions[vertex, 1] = y + share * (axis == 1)
                    positions[vertex, 2] = z + share * (axis == 2)
                    vertex += 1
            case = _case(top, values, level, x, y, z)
            for k in range(table.sizes[case]):
                for corner in range(3):
                    edge = table.edges[case, k, corner]
                    start, axis = starts_of[edge], edge >> 2
                    i, j, m = x + (start >> 2), y + (start >> 1 & 1), z + (start & 1)
                    owner = top[i >> BITS, j >> BITS, m >> BITS]
                    own = first[owner, slot_of(i, j, m)]
                    crossed = _crossed(top, values, level, i, j, m)
                    before = (crossed >> 2 if axis > 0 else 0) + (crossed >> 1 & 1 if axis > 1 else 0)
                    faces[triangle, corner] = own + before
                triangle += 1
