"""Planes and lines whose products are a lattice's values, as files name and turn them; the formula: kernels.lattice."""

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
    """planes (A, B, R) across x and y, x and z, y and z, by their names; lines (C, R) along z, y, x; matrix (rows, C),
    which `name` is. Raises InvalidFile where their sizes do not go together."""
    (first, *_), xy = planes, next(iter(planes.values()))
    shape = (*xy.shape[:2], next(iter(lines.values())).shape[0])
    if not all(2 <= edge <= MAX_EDGE for edge in shape):
        raise InvalidFile(Problem(first, f"is of a lattice of {shape}", f"2 to {MAX_EDGE} nodes an axis"))
    for (plane, a), (line, b), axes in zip(
        planes.items(), lines.items(), ((0, 1, 2), (0, 2, 1), (1, 2, 0)), strict=True
    ):
        edges = tuple(shape[axis] for axis in axes)
        if a.shape != (*edges[:2], a.shape[2]) or b.shape != (edges[2], a.shape[2]):
            found = f"has {a.shape}, {line} {b.shape} (nodes, then parts)"
            raise InvalidFile(Problem(plane, found, f"nodes of {shape}, and as many parts"))
    rows = sum(a.shape[2] for a in planes.values())
    if matrix.ndim != 2 or matrix.shape[0] != rows or not rows:
        raise InvalidFile(Problem(name, f"is for {matrix.shape[:1]} parts", f"{rows:,}, as planes have"))
    arrays = (*planes.values(), *lines.values(), matrix)
    memory.hold(first, 4 * sum(array.size for array in arrays))
    return Factors(*(np.ascontiguousarray(array, np.float32) for array in arrays))


def shape_of(factors: Factors) -> Shape:
    """Nodes along x, y and z."""
    return factors.xy.shape[0], factors.xy.shape[1], factors.xz.shape[1]


def rows_of(links: npt.NDArray[np.int32], n: int, factors: Factors, what: str) -> Singles:
    """(n, C) the values of the nodes that links (X, Y, Z) lead to a row. Raises MemoryLimit."""
    memory.hold(what, 4 * n * factors.matrix.shape[1])
    out = np.zeros((n, factors.matrix.shape[1]), np.float32)
    values_of(links, factors, out)
    return out
