"""The visual hull of silhouettes: cells that are in front of the background in any view are empty."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.march.lines import Line, cell_at, exits, line_of
from nerfbake.kernels.parallel import on_every_core

Marks = npt.NDArray[np.uint8]
Counts = npt.NDArray[np.uint16]
_HELD, _CLEAR = 1, 2
TASKS = 4  # tasks that share the rays of a view


def mark_clear(
    low: Floats, size: Floats, eye: Floats, directions: Singles, held: Bits, met: Marks, clear: Counts, inside: Counts
) -> None:
    """Add 1 to `inside` for each cell that a view sees, and 1 to `clear` for each that only background rays cross.

    inside, clear (R, R, R). low, size, eye (3,): the corner of the lattice, the size of a cell, and the camera, in the
    world. directions (m, 3) and held (m,): the rays, and whether each hits the object. met (TASKS, R, R, R): a buffer.
    """
    place = (eye - low) / size
    _mark_parts(place, size, directions, held, met)
    _count(met, clear, inside)


@on_every_core
@compiled()
def _mark_parts(
    core: int, cores: int, place: Floats, size: Floats, directions: Singles, held: Bits, met: Marks
) -> None:
    """March the rays of each task and mark cells in the task's part of the buffer."""
    place, size, directions, held, met = borrowed((place, size, directions, held, met))
    for task in range(core, TASKS, cores):
        own = met[task]
        own[:] = 0
        begin, end = part_of(len(directions), task, TASKS)
        for ray in range(begin, end):
            way = directions[ray, 0] / size[0], directions[ray, 1] / size[1], directions[ray, 2] / size[2]
            line = line_of((place[0], place[1], place[2]), way)
            _mark(line, np.uint8(_HELD if held[ray] else _CLEAR), own)


@on_every_core
@compiled()
def _count(core: int, cores: int, met: Marks, clear: Counts, inside: Counts) -> None:
    """Combine the marks of all tasks."""
    for x in range(core, len(clear), cores):
        for y in range(clear.shape[1]):
            for z in range(clear.shape[2]):
                marks = np.uint8(0)
                for task in range(TASKS):
                    marks |= met[task, x, y, z]
                inside[x, y, z] += marks > 0
                clear[x, y, z] += marks == _CLEAR


@compiled()
def _mark(line: Line, mark: Any, met: Marks) -> None:
    """Mark the cells along a ray."""
    R = met.shape[0]
    start, end = 0.0, np.inf
    for axis in range(3):
        start, end = part_between(line.origin[axis], line.inverse[axis], R, start, end)
    if start >= end:
        return
    x, y, z = cell_at(line, start, (0, 0, 0), (R - 1, R - 1, R - 1))
    d0, d1, d2 = line.direction
    while 0 <= x < R and 0 <= y < R and 0 <= z < R:
        met[x, y, z] |= mark
        exit0, exit1, exit2 = exits((x, y, z), 1, line)
        if exit0 <= exit1 and exit0 <= exit2:
            x += 1 if d0 > 0 else -1
        elif exit1 <= exit2:
            y += 1 if d1 > 0 else -1
        else:
            z += 1 if d2 > 0 else -1


@compiled(merged=True)
def part_between(origin: float, inverse: float, edge: float, start: float, end: float) -> Any:
    """Clip a ray from start to end to 0 .. edge along one axis; inverse: one over its direction."""
    if inverse == np.inf or inverse == -np.inf:
        return start, end if 0 <= origin < edge else -1.0
    near, far = -origin * inverse, (edge - origin) * inverse
    return max(start, min(near, far)), min(end, max(near, far))
