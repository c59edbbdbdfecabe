"""The axes of files of splats: where x, y and z point, seen by a person before whom the scene stands.

Three letters name the directions of x, y and z: right or left, up or down, forward or back. The world of Splats is RDF,
that of a .ply from the usual trainers: x right, y down, z forward.

Source: nianticlabs/spz, coordinate-system-adobe.cc (the order of the names); glTF 2.0, section 3.4.
"""

from __future__ import annotations

from dataclasses import replace
from typing import get_args

import numpy as np

from nerfbake import memory
from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose
from nerfbake.scene.splats import MOVING, Axes, Splats, splats_size

AXES: tuple[Axes, ...] = get_args(Axes)
_DIRECTIONS = {"L": (-1, 0, 0), "R": (1, 0, 0), "U": (0, -1, 0), "D": (0, 1, 0), "B": (0, 0, -1), "F": (0, 0, 1)}


def directions_of(axes: Axes) -> Floats:
    """Return the directions (3, 3) of x, y and z in the world, as rows.

    >>> from nerfbake.scene.splat_axes import directions_of
    >>> directions_of("RUB").tolist()
    [[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]]
    """
    return np.array([_DIRECTIONS[letter] for letter in axes], np.float64)


def from_axes(splats: Splats, axes: Axes) -> Splats:
    """Return splats in the world, whose numbers are in these axes. Raises MemoryLimit."""
    return replace(_turned(splats, directions_of(axes).T.copy()), axes=axes)


def to_axes(splats: Splats, axes: Axes) -> Splats:
    """Return the splats with their numbers in these axes. Raises MemoryLimit."""
    return _turned(splats, directions_of(axes))


def with_axes(splats: Splats, axes: Axes) -> Splats:
    """Return the splats as they are if their file has these axes, instead of those in which it was read."""
    if splats.axes is None:
        return splats
    return replace(
        _turned(splats, compose(directions_of(axes).T, directions_of(splats.axes))), axes=axes, axes_known=True
    )


def _turned(splats: Splats, turn: Floats) -> Splats:
    """Return the splats turned by a matrix of 0, 1 and -1: exactly if it only changes signs."""
    signs = np.diagonal(turn)
    if (signs == 1).all():
        return splats
    memory.hold("the splats", splats_size(splats.n, splats.B))
    if signs.all():
        x, y, z = (1 if sign > 0 else -1 for sign in signs)
        return splats.flipped((x, y, z))
    with memory.lent("the splats", MOVING * splats.n):
        return splats.transformed(np.column_stack([turn, np.zeros(3)]))
