"""Features of points that are products of values across x and y, across x and z, and across y and z, as in K-Planes."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from nerfbake.kernels.arrays import Ints, Singles, as_input, f32
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

_BLOCK = 1024  # points at a time


class PackedPlanes(NamedTuple):
    """The planes of all scales.

    values  (n,) float32: for each scale its planes (Y, X, C), (Z, X, C) and (Z, Y, C)
    nodes   (S, 3) int64: X, Y, Z of each scale
    channels  C
    """

    values: Singles
    nodes: Ints
    channels: int


def plane_features(planes: PackedPlanes, points: Singles, *, concatenated: bool) -> Singles:
    """Return the features of points (m, 3) float32 in the unit cube: (S C, m), or (C, m), the sum of the scales."""
    values, nodes, C = planes
    out = np.zeros((len(points), C * (len(nodes) if concatenated else 1)), np.float32)
    _interpolate(as_input(values), as_input(nodes), C, as_input(points), C if concatenated else 0, out)
    return np.ascontiguousarray(out.T)


@compiled()
def _multiply(values: Singles, start: int, columns: int, rows: int, C: int, u: f32, v: f32, out: Singles) -> None:
    """Multiply out (C,) by the value of a plane at u along its columns and v along its rows, from 0 to 1."""
    x = min(max(u * f32(columns - 1), f32(0)), f32(columns - 1))
    y = min(max(v * f32(rows - 1), f32(0)), f32(rows - 1))
    i, j = int(x), int(y)
    right, down = min(i + 1, columns - 1), min(j + 1, rows - 1)
    x, y = x - f32(i), y - f32(j)
    a, b = start + (j * columns + i) * C, start + (j * columns + right) * C
    c, d = start + (down * columns + i) * C, start + (down * columns + right) * C
    wa, wb, wc, wd = (f32(1) - x) * (f32(1) - y), x * (f32(1) - y), (f32(1) - x) * y, x * y
    for k in range(C):
        out[k] *= (values[a + k] * wa + values[b + k] * wb) + (values[c + k] * wc + values[d + k] * wd)


@on_every_core
@compiled()
def _interpolate(
    core: int, cores: int, values: Singles, nodes: Ints, C: int, points: Singles, step: int, out: Singles
) -> None:
    """step: how far apart the features of two scales are in out; 0: they are added."""
    product = np.empty(C, np.float32)
    for block in range(core, (len(points) + _BLOCK - 1) // _BLOCK, cores):
        for p in range(block * _BLOCK, min((block + 1) * _BLOCK, len(points))):
            start = 0
            for s in range(len(nodes)):
                X, Y, Z = nodes[s, 0], nodes[s, 1], nodes[s, 2]
                x, y, z = points[p, 0], points[p, 1], points[p, 2]
                product[:] = 1
                _multiply(values, start, X, Y, C, x, y, product)
                _multiply(values, start + X * Y * C, X, Z, C, x, z, product)
                _multiply(values, start + X * (Y + Z) * C, Y, Z, C, y, z, product)
                start += (X * Y + X * Z + Y * Z) * C
                for k in range(C):
                    out[p, s * step + k] += product[k]
