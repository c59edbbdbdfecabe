"""Trained function -> the part of it that is baked: a box around an object, or an inner cube with scenery around it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake import progress
from nerfbake.kernels.arrays import Ints, Points
from nerfbake.scene.camera import Cameras
from nerfbake.scene.function_field import FunctionField
from nerfbake.scene.n3tree import MAX_SHELLS
from nerfbake.stages._function_cells import FunctionCells, baking_views, find_cells, see, spread_cameras
from nerfbake.stages._scenery import SHELLS, inner_cube_of
from nerfbake.stages.scene_to_cameras import scatter_cameras

SCENERY = 0.05  # share of the light from outside of the middle cubes, from which a field is scenery
_RESOLUTION = 64  # of the lattice on which light is counted
_MIDDLE = 1  # the shell that still belongs to the middle
_CLEAR = 0.02  # cells that absorb less of every ray are fog, which does not count for the box of an object
_AROUND, _EDGE = 48, 256  # number of cameras around a field without cameras, and their pixels along an edge
_STRAYS = 2e-4  # share of the light that is left out at each side


class FunctionPart(NamedTuple):
    """The part of a field that is baked.

    box      (2, 3) the box, or the inner cube, in the world
    shells   with the inner cube; 1: no scenery
    outside  share of the light that the cameras get from outside of the middle of the field; None: not measured
    """

    box: Points
    shells: int
    outside: float | None = None

    @property
    def whole(self) -> Points:
        """(2, 3) the box around all shells."""
        middle, half = self.box.mean(axis=0), (self.box[1] - self.box[0]) / 2 * 2.0 ** (self.shells - 1)
        return np.stack([middle - half, middle + half])


def identify_function_part(
    field: FunctionField, cameras: Cameras | None = None, *, box: Points | None = None, scenery: bool | None = None
) -> FunctionPart:
    """Return the part that is baked. None as `scenery`: only if much light comes from outside of the middle.

    The middle is twice the cube around what the cameras look at, which is as wide as they are away from it. An object
    has the smallest cube around what is visible, which leaves out fog and strays; scenery has the cube of the cameras.
    box: the box or inner cube, which then has shells only if `scenery` is true. cameras: None: those of the field, or
    some around it. Raises InvalidScene, MemoryLimit.

    >>> import numpy as np
    >>> from nerfbake import FunctionField, identify_function_part
    >>> from nerfbake.scene.lattice_field import Activation
    >>> from nerfbake.scene.network import Frequencies, HeadColour, Mlp, Network
    >>> fog = Mlp((np.zeros((1, 3), np.float32),), (np.full(1, 9, np.float32),))
    >>> grey = HeadColour(Mlp((np.zeros((3, 1), np.float32),), (np.zeros(3, np.float32),)), "none")
    >>> network = Network(Frequencies(np.zeros(0)), fog, np.ones(1, np.float32), 0.0, Activation("relu"), grey)
    >>> field = FunctionField(network, np.eye(3, 4), np.array([[-1.0] * 3, [1.0] * 3]))
    >>> part = identify_function_part(field)
    >>> part.shells, part.outside, bool((np.abs(part.box) < 1.1).all())
    (1, 0.0, True)
    """
    field.require_usable()
    cameras = cameras or cameras_of(field)
    if box is not None:
        return FunctionPart(box, _reach(field, box, MAX_SHELLS) if scenery else 1)
    focus, own = inner_cube_of(cameras) if len(cameras.cameras) > 1 else None, _cube(field.world_box)
    if focus is None or (not field.contracted and own[1, 0] - own[0, 0] < focus[1, 0] - focus[0, 0]):
        focus = own
    shells = _reach(field, focus, SHELLS)
    with progress.part(0, 0.7):
        cells = find_cells(field, focus, _RESOLUTION, shells, 0.0)
    views = baking_views(spread_cameras(cameras), focus, _RESOLUTION)
    with progress.part(0.7, 1):
        seen = see(cells, views, field.near / field.scale, total=True)
    shell = cells.shell_of()
    whole = max(int(seen.total.sum()), 1)
    outside = int(seen.total[shell > _MIDDLE].sum()) / whole
    if outside > SCENERY and scenery is not False:
        return FunctionPart(focus, shells, outside)
    clear = (seen.largest >= _CLEAR) & (shell <= _MIDDLE)
    inner = _tight(cells, np.where(clear if clear.any() else shell <= _MIDDLE, seen.total, 0))
    inner = _cube(inner)
    return FunctionPart(inner, _reach(field, inner, MAX_SHELLS) if scenery else 1, outside)


def cameras_of(field: FunctionField) -> Cameras:
    """Return the cameras that the field was trained with, or else cameras all around it."""
    return field.cameras or scatter_cameras(field, frames=_AROUND, edge=_EDGE)


def _reach(field: FunctionField, box: Points, most: int) -> int:
    """Return how many shells around a box cover the field, at most `most`."""
    if field.contracted:
        return most
    half, middle = (box[1] - box[0]) / 2, box.mean(axis=0)
    shells = 1
    while shells < most and (np.abs(field.world_box - middle) > half * 2.0 ** (shells - 1)).any():
        shells += 1
    return shells


def _cube(box: Points) -> Points:
    middle, half = box.mean(axis=0), float((box[1] - box[0]).max()) / 2
    return np.stack([middle - half, middle + half])


def _tight(cells: FunctionCells, light: Ints) -> Points:
    """Return the box (2, 3) of the light without strays, with a cell around it."""
    held = np.flatnonzero(light)
    if not len(held):
        held, light = np.arange(cells.n), np.ones(cells.n, np.int64)
    centres, amount = cells.centres()[held], light[held]
    reach = cells.width[cells.shell_of()[held]]
    corners = np.empty((2, 3))
    for axis in range(3):
        for side, sign in enumerate((1, -1)):
            faces = centres[:, axis] - sign * reach * 1.5
            order = np.argsort(sign * faces, kind="stable")
            passed = np.cumsum(amount[order])
            corners[side, axis] = faces[order[int(np.searchsorted(passed, _STRAYS * int(passed[-1])))]]
    return corners
