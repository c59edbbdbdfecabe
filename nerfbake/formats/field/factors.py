"""Check planes and lines read from a file, and compute lattice values from them. Formula: kernels.lattice.planes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake import memory
from nerfbake.errors import InvalidFile, Problem
from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.lattice.planes import Factors, values_of
from nerfbake.scene.lattice_field import MAX_EDGE

Shape = tuple[int, int, int]


def factors_of(
    planes: dict[str, npt.NDArray[Any]], lines: dict[str, npt.NDArray[Any]], matrix: Singles, name: str
) -> Factors:
    """Combine planes, lines and the matrix. Raises InvalidFile if their sizes do not match.

    planes: (A, B, R) across x and y, x and z, y and z, by name. lines: (C, R) along z, y, x, by name.
    matrix: (rows, C); `name` is its name in error messages.
    """
    (first, *_), xy = planes, next(iter(planes.values()))
    shape = (*xy.shape[:2], next(iter(lines.values())).shape[0])
    if not all(2 <= edge <= MAX_EDGE for edge in shape):
        raise InvalidFile(Problem(first, f"is of a lattice of {shape}", f"2 to {MAX_EDGE} nodes an axis"))
    for (plane, a), (line, b), axes in zip(
        planes.items(), lines.items(), ((0, 1, 2), (0, 2, 1), (1, 2, 0)), strict=True
    ):
        edges = tuple(shape[axis] for axis in axes)
        if a.shape != (*edges[:2], a.shape[2]) or b.shape != (edges[2], a.shape[2]):
            found = f"has shape {a.shape}, {line} {b.shape} (nodes, then parts)"
            raise InvalidFile(Problem(plane, found, f"nodes of {shape}, and the same number of parts"))
    rows = sum(a.shape[2] for a in planes.values())
    if matrix.ndim != 2 or matrix.shape[0] != rows or not rows:
        raise InvalidFile(Problem(name, f"is for {matrix.shape[:1]} parts", f"{rows:,}, the parts of all planes"))
    arrays = (*planes.values(), *lines.values(), matrix)
    memory.hold(first, 4 * sum(array.size for array in arrays))
    return Factors(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def shape_of(factors: Factors) -> Shape:
    """Return the number of nodes along x, y and z."""
    return factors.xy.shape[0], factors.xy.shape[1], factors.xz.shape[1]


def rows_of(links: npt.NDArray[np.int32], n: int, factors: Factors, what: str) -> Singles:
    """Compute the values (n, C) of all nodes whose link is not negative; links are (X, Y, Z). Raises MemoryLimit."""
    memory.hold(what, 4 * n * factors.matrix.shape[1])
    out = np.zeros((n, factors.matrix.shape[1]), np.float32)
    values_of(links, factors, out)
    return out
