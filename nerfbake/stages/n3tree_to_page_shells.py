"""PlenOctree with scenery -> the fields of a page for the shells around its inner cube."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from nerfbake.kernels.arrays import Points, Singles
from nerfbake.kernels.march.cells import rows_at
from nerfbake.kernels.maths.affine import length, rotate
from nerfbake.kernels.maths.elementary import log, sigmoid
from nerfbake.scene.basis import Basis
from nerfbake.scene.camera import Camera
from nerfbake.scene.n3tree import N3Tree
from nerfbake.scene.page import CELL, FARTHEST, PageField, texels_of
from nerfbake.scene.radiance_field import RadianceField, leaves_of
from nerfbake.stages._basis_functions import basis_at
from nerfbake.stages._scenery import sees
from nerfbake.stages.field_to_page_field import build_page_field
from nerfbake.stages.n3tree_to_octree import build_octree
from nerfbake.stages.scene_to_field import build_field

_COLOURS = 0.002, 0.998  # a sigmoid does not reach 0 and 1
RESOLUTION = 128  # voxels along an edge of a shell's cube


def build_page_shells(tree: N3Tree, *, resolution: int = RESOLUTION) -> tuple[PageField, ...]:
    """Return a field for the cube of each shell, from the innermost one; () for a tree without scenery.

    Each field has resolution^3 voxels, means of finer cells as in build_octree(). Its middle, which is the next smaller
    cube, is empty. Colours are the same in all directions, which takes a sixth of the bytes: the means of what the
    cameras of the held-out photographs see. Raises InvalidScene, MemoryLimit.

    >>> from nerfbake import build_page_shells, sample_n3tree
    >>> build_page_shells(sample_n3tree(resolution=8))
    ()
    """
    found: list[PageField] = []
    cameras = () if tree.held_out is None else tree.held_out.cameras.cameras
    for shell in range(1, tree.shells):
        cube = replace(tree, shells=tree.shells - shell, held_out=None).inner_cube()
        octree = build_octree(_without_middle(replace(cube, shells=1)), resolution=resolution, layout="compact")
        field = build_field(octree)
        if len(field.values):
            box = np.array([[0.0] * 3, [float(resolution)] * 3])
            found.append(build_page_field(replace(field, values=_flattened(field, cameras), box=box)))
        else:
            found.append(_empty(field.place, field.basis, resolution))
    return tuple(found)


def _flattened(field: RadianceField, cameras: tuple[Camera, ...]) -> Singles:
    """Return the values of a field with colours that are the same in all directions.

    They are the means of the colours from the cameras that see a cell, or from all cameras if none does.
    """
    m, B = len(field.values), field.basis.size
    values = field.values.copy()
    if B == 1:
        return values
    coefficients = values[:, :-1].reshape(m, 3, B)
    centre, width = np.empty((m, 3)), np.empty(m)
    for corners, edge in leaves_of(field.cells):
        rows = rows_at(field.cells, corners + 0.5)
        centre[rows], width[rows] = field.world(corners + edge / 2), edge
    width /= length(field.place[0, :3])
    seen, everywhere, counts = np.zeros((m, 3)), np.zeros((m, 3)), np.zeros((m, 1))
    for camera in cameras:
        along = centre - camera.pose[:3, 3]
        along /= np.maximum(np.sqrt(np.square(along).sum(axis=1, keepdims=True)), 1e-30)
        basis = basis_at(field.basis, rotate(along, field.axes))
        colour = sigmoid((coefficients * basis[:, None]).sum(axis=2))
        visible = sees(camera, centre, width)[:, None]
        seen, everywhere, counts = seen + visible * colour, everywhere + colour, counts + visible
    flat = coefficients[:, :, 0]
    if cameras:
        mean = np.where(counts > 0, seen / np.maximum(counts, 1), everywhere / len(cameras)).clip(*_COLOURS)
        flat = log(mean / (1 - mean)) / basis_at(field.basis, np.eye(3)[:1])[0, 0]
    values[:, :-1] = 0
    values[:, : 3 * B : B] = flat
    return values


def _without_middle(cube: N3Tree) -> N3Tree:
    """Return the tree with an empty middle, half as wide as its cube."""
    cube.require_sound()
    child, data = cube.child.copy().reshape(cube.n, 8), cube.data.copy().reshape(cube.n, 8, -1)
    for octant, step in enumerate(child[0]):
        if step:
            child[step, 7 - octant] = 0
            data[step, 7 - octant] = 0
    return replace(cube, child=child.reshape(cube.child.shape), data=data.reshape(cube.data.shape))


def _empty(place: Points, basis: Basis, resolution: int) -> PageField:
    edge, nothing = resolution // CELL, np.zeros((0, texels_of(basis), 4), np.float16)
    top = np.full((edge,) * 3, -FARTHEST, np.int32)
    box = np.array([[0.0] * 3, [float(resolution)] * 3])
    return PageField(top, np.zeros((0, 4), np.uint32), nothing, 1.0, place, box, basis)
