"""Where a scene is put in a world: rotations, scales and translations, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.affine import compose
from nerfbake.kernels.maths.elementary import sine_cosine

_AXES = ((1, 2), (2, 0), (0, 1))  # the plane that a rotation about x, y or z turns


class Move(NamedTuple):
    """A step of a placement.

    kind     t: translate by x, y, z; r: rotate by degrees about x, then y, then z, counter-clockwise seen from the end
             of the axis; s: scale by one factor
    numbers  three, of a scale one
    """

    kind: Literal["t", "r", "s"]
    numbers: tuple[float, ...]


def placement_matrix(moves: Sequence[Move]) -> Floats:
    """Return the (3, 4) matrix of these steps, the first of which is applied first. Quarter turns are exact."""
    matrix = np.eye(4)
    for move in moves:
        step = np.eye(4)
        if move.kind == "t":
            step[:3, 3] = move.numbers
        elif move.kind == "s":
            step[:3, :3] *= move.numbers[0]
        else:
            for (a, b), degrees in zip(_AXES, move.numbers, strict=True):
                quarters = round(degrees / 90)
                sine, cosine = (float(each) for each in sine_cosine(np.radians(degrees - 90 * quarters)))
                for _ in range(quarters % 4):
                    sine, cosine = cosine, -sine
                turn = np.eye(4)
                turn[a, a], turn[a, b], turn[b, a], turn[b, b] = cosine, -sine, sine, cosine
                step = compose(turn, step)
        matrix = compose(step, matrix)
    return matrix[:3]
