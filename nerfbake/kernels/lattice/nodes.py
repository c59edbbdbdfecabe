"""Interpolation between the nodes of a lattice: trilinear values, and the densities computed from them.

Positions are fractions of the lattice's box, 0 to 1 along each axis. Of the N nodes of an axis, node i is at
(i + 1/2)/N, or at i/(N - 1) if the first and the last node are on the faces of the box. Before the first node and after
the last one, values are constant. A link below 0 reads as zeros.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Singles, as_input
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.lattice.blocks import NO_PLANES, NOWHERE, raw_at
from nerfbake.kernels.parallel import on_every_core

RELU, SOFTPLUS, OPACITY, EXPONENTIAL = 0, 1, 2, 3
_LN2 = 0.6931471805599453
_LEAST_LEFT = 1 / 510  # half of the smallest share in 8 bits


class DensityNodes(NamedTuple):
    """The inputs of a density.

    links (X, Y, Z): rows of density (n,). kind, shift and scale convert a value to density per world unit, as in
    scene.lattice_field; a density that does not exceed `least` counts as 0. mask (X', Y', Z'): number
    int(u times + plus) along each axis is set if there may be density at a position u; outside the mask there is none.
    corners: 1 if nodes are on the faces of the box, else 0. edge: not 0 if links point to blocks; the fields after it
    are then those of kernels.lattice.blocks. planes (3, P, P): values that are added to the density of the blocks.
    """

    links: npt.NDArray[np.int32]
    density: Singles
    mask: Bits
    times: Floats
    plus: Floats
    corners: int
    kind: int
    shift: float
    scale: float
    least: float
    edge: int = 0
    block_times: Floats = NOWHERE
    block_plus: Floats = NOWHERE
    plane_times: float = 0.0
    plane_plus: float = 0.0
    planes: Singles = NO_PLANES


def nearest_in(mask: Bits) -> tuple[Floats, Floats]:
    """times and plus of DensityNodes for a mask whose first and last nodes are on the faces: the nearest one counts."""
    return np.array(mask.shape, np.float64) - 1, np.full(3, 0.5)


def cells_in(mask: Bits, box: Floats, own: Floats) -> tuple[Floats, Floats]:
    """times and plus of DensityNodes for a mask of cells that divide another box, `own` (2, 3), than the lattice's."""
    edges = (own[1] - own[0]) / np.array(mask.shape)
    return (box[1] - box[0]) / edges, (box[0] - own[0]) / edges


def densities(nodes: DensityNodes, places: Floats) -> Singles:
    """(m,) densities per world unit at positions (m, 3) in the box."""
    out = np.empty(len(places), np.float32)
    _densities(nodes, np.ascontiguousarray(places), out)
    return out


def interpolate_rows(links: npt.NDArray[np.int32], table: Singles, at: Floats) -> Singles:
    """(m, C) interpolated rows of a table (n, C), through links, at (m, 3) in nodes; the first node of an axis is 0."""
    out = np.empty((len(at), table.shape[1]), np.float32)
    _blended(as_input(links), table, at, out)
    return out


def in_nodes(places: Floats, shape: tuple[int, int, int], corners: bool) -> Floats:
    """(m, 3) positions in nodes, from positions in the box of a lattice of this shape."""
    edges = np.array(shape, np.float64)
    at: Floats = places * (edges - 1) if corners else places * edges - 0.5
    return np.clip(at, 0, edges - 1)


@on_every_core
@compiled()
def _densities(core: int, cores: int, nodes: DensityNodes, places: Floats, out: Singles) -> None:
    nodes, places, out = borrowed((nodes, places, out))
    begin, end = part_of(len(places), core, cores)
    for i in range(begin, end):
        out[i] = density_at(nodes, places[i, 0], places[i, 1], places[i, 2])


@compiled(merged=True)
def density_at(nodes: DensityNodes, u: float, v: float, w: float) -> float:
    """Density per world unit at a position in the box; 0 where the mask is not set, or up to `least`.

    Only the first two lines name the tuple: after each branch numba counts references to its arrays, which took half of
    the 90 ns of a sample.
    """
    kind, shift, scale, least = nodes.kind, nodes.shift, nodes.scale, nodes.least
    held, total = _raw(nodes, u, v, w) if _in_mask(nodes, u, v, w) else (False, 0.0)
    found = scale * _activated(kind, total + shift) if held else 0.0
    return found if found > least else 0.0


@compiled(merged=True)
def _in_mask(nodes: DensityNodes, u: float, v: float, w: float) -> bool:
    """Whether the mask is set at a position."""
    A, B, C = nodes.mask.shape
    a = u * nodes.times[0] + nodes.plus[0]
    b = v * nodes.times[1] + nodes.plus[1]
    c = w * nodes.times[2] + nodes.plus[2]
    inside = (a >= 0) & (a <= A) & (b >= 0) & (b <= B) & (c >= 0) & (c <= C)
    i, j, k = min(max(int(a), 0), A - 1), min(max(int(b), 0), B - 1), min(max(int(c), 0), C - 1)
    return bool(inside & nodes.mask[i, j, k])


@compiled(merged=True)
def _raw(nodes: DensityNodes, u: float, v: float, w: float) -> tuple[bool, float]:
    """Whether there is any value around a position, and the interpolated value."""
    return raw_at(nodes, u, v, w) if nodes.edge > 0 else _linked(nodes, u, v, w)


@compiled()
def _activated(kind: int, raw: float) -> float:
    if kind == RELU:
        return max(raw, 0.0)
    if kind == SOFTPLUS:
        return softplus_of(raw)
    if kind == EXPONENTIAL:
        whole, rest = compiled_exp_parts(raw)
        return float(whole + whole * rest)
    return thickness_of(raw)


@compiled(merged=True)
def _linked(nodes: DensityNodes, u: float, v: float, w: float) -> tuple[bool, float]:
    """Whether any node around a position has a value, and the interpolated value."""
    X, Y, Z = nodes.links.shape
    corners = nodes.corners
    x, fx = _below(u * (X - 1) if corners else u * X - 0.5, X)
    y, fy = _below(v * (Y - 1) if corners else v * Y - 0.5, Y)
    z, fz = _below(w * (Z - 1) if corners else w * Z - 0.5, Z)
    total, held = 0.0, False
    for corner in range(8):
        i, j, k = x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1)
        row = nodes.links[min(i, X - 1), min(j, Y - 1), min(k, Z - 1)]
        share = (fx if corner & 4 else 1 - fx) * (fy if corner & 2 else 1 - fy) * (fz if corner & 1 else 1 - fz)
        if row >= 0 and share > 0:
            total, held = total + share * nodes.density[row], True
    return held, total


@on_every_core
@compiled()
def _blended(core: int, cores: int, links: npt.NDArray[np.int32], table: Singles, at: Floats, out: Singles) -> None:
    links, table, at, out = borrowed((links, table, at, out))
    X, Y, Z = links.shape
    begin, end = part_of(len(at), core, cores)
    for n in range(begin, end):
        own = out[n]
        own[:] = 0
        x, fx = _below(at[n, 0], X)
        y, fy = _below(at[n, 1], Y)
        z, fz = _below(at[n, 2], Z)
        for corner in range(8):
            i, j, k = x + (corner >> 2), y + (corner >> 1 & 1), z + (corner & 1)
            row = links[min(i, X - 1), min(j, Y - 1), min(k, Z - 1)]
            share = (fx if corner & 4 else 1 - fx) * (fy if corner & 2 else 1 - fy) * (fz if corner & 1 else 1 - fz)
            if row >= 0 and share > 0:
                weight, values = np.float32(share), table[row]
                for column in range(len(values)):
                    own[column] += weight * values[column]


@compiled()
def _below(at: float, count: int) -> tuple[int, float]:
    """The node below a position, and the distance from there in nodes, 0 to 1."""
    at = min(max(at, 0.0), count - 1.0)
    low = int(at)
    return low, at - low


@compiled()
def softplus_of(x: float) -> float:
    """ln(1 + e^x).

    With e = e^-|x|, uses the series of 2 artanh(e / (2 + e)), accurate to the last digits where e is small.
    """
    whole, rest = compiled_exp_parts(-abs(x))
    small = whole + whole * rest
    s = small / (2 + small)
    z = s * s
    series = 1 / 33
    for n in range(31, 0, -2):
        series = series * z + 1 / n
    return float(max(x, 0.0) + 2 * s * series)


@compiled()
def thickness_of(opacity: float) -> float:
    """-ln(1 - x) for an opacity x, clamped to 1 - 1/510.

    1 - x is doubled until it is near 1, where the series of 2 artanh is used.
    """
    left, doubled = max(1 - max(opacity, 0.0), _LEAST_LEFT), 0.0
    while left < 0.7071067811865476:
        left, doubled = left * 2, doubled + 1
    s = (left - 1) / (left + 1)
    z = s * s
    series = 1 / 19
    for n in range(17, 0, -2):
        series = series * z + 1 / n
    return float(doubled * _LN2 - 2 * s * series)
