"""Occupancy grids of the instant-ngp family: nested cubes of 128^3 cells, each in Morton order.

Bits 0, 3, 6, ... of a cell's number are its x, the next ones y, the next ones z.
"""

from __future__ import annotations

import numpy as np

from nerfbake import memory
from nerfbake.kernels.arrays import Bits
from nerfbake.scene.function_field import Occupancy

EDGE = 128
CELLS = EDGE**3
_BITS = 7  # of a coordinate


def nested_cubes(flags: Bits, centre: float, halves: list[float]) -> Occupancy:
    """Return the occupancy of cells (C, 128^3) in Morton order. halves: half the edge of each cube, ascending."""
    memory.hold("the occupancy", flags.size)
    axes = [1 + 3 * (_BITS - 1 - bit) + (2 - axis) for axis in range(3) for bit in reversed(range(_BITS))]
    cells = flags.reshape(len(flags), *(2,) * (3 * _BITS)).transpose(0, *axes)
    cube = np.array([[-1.0] * 3, [1.0] * 3])
    boxes = np.stack([centre + half * cube for half in halves])
    return Occupancy(np.ascontiguousarray(cells).reshape(len(flags), EDGE, EDGE, EDGE), boxes)
