"""Radiance field -> a mesh of boxes that encloses all visible leaves."""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.arrays import Bits, Ints
from nerfbake.scene.mesh import Mesh, Meshes
from nerfbake.scene.radiance_field import RadianceField, leaves_of, require_field

FINEST = 12  # 4096 boxes along an axis, the largest number of voxels in an octree
_BOX_BYTES = 12  # per box of the grid, while the faces are computed
_FACE_BYTES = 400  # per face


def build_hull(field: RadianceField, *, level: int = 5) -> Meshes:
    """Return the faces between occupied and empty boxes, in world units.

    level: the longest edge of the box around all leaves is at most 2^level boxes long, plus one if the boxes are not
    aligned with it. Boxes are cubes of 2^k voxels, aligned like the nodes of an octree, and never smaller than a
    voxel. They are clipped to the box around all leaves.

    The mesh encloses every leaf with a density, up to the rounding to float32; trilinear lookup extends half a voxel
    further. Faces are counter-clockwise seen from outside. Each side of a box is two triangles, and there are no
    T-junctions. Vertices are shared. The surface has no gaps; it is a manifold unless two boxes touch only along an
    edge or at a corner.

    Raises InvalidScene if nothing is visible, MemoryLimit. Source: TR-24-01 (docs/sources.md), 3.4.

    >>> from nerfbake import build_field, build_hull, sample_n3tree
    >>> print(build_hull(build_field(sample_n3tree(resolution=16)), level=2))
    mesh of 144 triangles over 74 vertices
    """
    require_field(field)
    if not 0 <= level <= FINEST:
        raise InvalidScene(Problem("level", f"is {level}", f"0 to {FINEST}"))
    low, high = field.box.astype(np.int64)
    longest = int((high - low).max())
    edge = max(1 << (longest - 1).bit_length() >> level, 1)
    first = low // edge
    held = _held(field, first, -(-high // edge) - first, edge)
    if not held.any():
        problem = Problem("the field", "has no leaf with a density", "at least one, or there is nothing to enclose")
        raise InvalidScene(problem)
    corners, faces = _surface(held)
    positions = field.world(np.clip((first + corners) * edge, low, high).astype(np.float64)).astype(np.float32)
    # A transform that mirrors the world inverts the winding of every face.
    x, y, z = field.place[:, :3]
    if (np.cross(x, y) * z).sum() < 0:
        faces = faces[:, ::-1]
    return memory.kept(Meshes((Mesh(positions, None, np.ascontiguousarray(faces, np.uint32)),)))


def _held(field: RadianceField, first: Ints, shape: Ints, edge: int) -> Bits:
    """Return (X, Y, Z) bool: the boxes that contain a part of a leaf."""
    x, y, z = (int(count) + 1 for count in shape)
    memory.require("the hull's boxes", _BOX_BYTES * x * y * z)
    # Along each axis, a leaf adds 1 at its first box and subtracts 1 after its last: prefix sums count the leaves.
    count = np.zeros((x, y, z), np.int32)
    for corners, width in leaves_of(field.cells):
        # Leaves outside an octree's grid are never visible.
        lower = corners[(corners < field.box[1]).all(axis=1)].astype(np.int64)
        ends = [np.minimum(end - first, shape) for end in (lower // edge, -(-(lower + int(width)) // edge))]
        for corner in range(8):
            sides = [corner >> axis & 1 for axis in range(3)]
            at = tuple(ends[side][:, axis] for axis, side in enumerate(sides))
            np.add.at(count, at, -1 if sum(sides) % 2 else 1)
    for axis in range(3):
        np.cumsum(count, axis=axis, out=count)
    return np.asarray(count[:-1, :-1, :-1] > 0, bool)


def _surface(held: Bits) -> tuple[Ints, Ints]:
    """Return corners (v, 3), in boxes, and triangles (t, 3) of the faces around these boxes."""
    lattice = tuple(edge + 1 for edge in held.shape)
    strides = lattice[1] * lattice[2], lattice[2], 1
    quads = []
    for axis in range(3):
        beside, above = strides[(axis + 1) % 3], strides[(axis + 2) % 3]
        sides = np.pad(held, [(int(axis == k),) * 2 for k in range(3)])
        lower, upper = np.delete(sides, -1, axis), np.delete(sides, 0, axis)
        for inside, outside, around in ((lower, upper, 1), (upper, lower, -1)):
            place = np.argwhere(inside & ~outside)
            memory.require("the hull's faces", _FACE_BYTES * len(place))
            start = np.ravel_multi_index(tuple(place.T), lattice)
            quads.append(np.stack([start, start + beside, start + beside + above, start + above], axis=1)[:, ::around])
    corners, faces = np.unique(np.concatenate(quads), return_inverse=True)
    faces = faces.reshape(-1, 4)[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return np.stack(np.unravel_index(corners, lattice), axis=1), faces
