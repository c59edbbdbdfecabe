"""Between the nodes of a lattice: trilinear values, and the densities that are made of them.

Places are shares of the lattice's box, 0 to 1 along each axis. Of the N nodes of an axis number i stands at
(i + 1/2)/N, or at i/(N - 1) where the first and the last stand on the box; before the first one and behind the last one
values go on as they are there. A link below 0 reads as zeros.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.arrays import Bits, Floats, Singles
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.lattice.blocks import NO_PLANES, NOWHERE, raw_at
from nerfbake.kernels.maths.elementary import exp_parts

RELU, SOFTPLUS, OPACITY, EXPONENTIAL = 0, 1, 2, 3
_LN2 = 0.6931471805599453
_LEAST_LEFT = 1 / 510  # half of the least share that 8 bits tell
_exp_parts: Any = compiled()(exp_parts)


class Nodes(NamedTuple):
    """What a density is made of: links (X, Y, Z) to density (n,), of which kind, shift and scale make one per world
    unit, as scene.lattice_field has them; what is below `least` is none. mask (X', Y', Z'): number int(u times + plus)
    along each axis says whether there is anything at a place u; beyond the mask is nothing. corners: 1 where nodes
    stand on the box, else 0. edge: not 0 where links lead to blocks, as the fields behind it are
    kernels.lattice.blocks'; planes (3, P, P): what is added to their density.
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
    """times and plus of Nodes for a mask whose first and last nodes stand on the box: the nearest one counts."""
    return np.array(mask.shape, np.float64) - 1, np.full(3, 0.5)


def cells_in(mask: Bits, box: Floats, own: Floats) -> tuple[Floats, Floats]:
    """The same for a mask of as many cells of a box of its own (2, 3), beside the lattice's box."""
    edges = (own[1] - own[0]) / np.array(mask.shape)
    return (box[1] - box[0]) / edges, (box[0] - own[0]) / edges


def densities(nodes: Nodes, places: Floats) -> Singles:
    """(m,) densities per world unit at places (m, 3) in the box."""
    out = np.empty(len(places), np.float32)
    _densities(nodes, places, out)
    return out


def blended(links: npt.NDArray[np.int32], table: Singles, at: Floats) -> Singles:
    """(m, C) of a table (n, C) that links lead to, at (m, 3) in nodes, the first of an axis being 0."""
    out = np.empty((len(at), table.shape[1]), np.float32)
    _blended(links, table, at, out)
    return out


def in_nodes(places: Floats, shape: tuple[int, int, int], corners: bool) -> Floats:
    """(m, 3) in nodes for places in the box of a lattice of this shape."""
    edges = np.array(shape, np.float64)
    at: Floats = places * (edges - 1) if corners else places * edges - 0.5
    return np.clip(at, 0, edges - 1)


@compiled(parallel=True)
def _densities(nodes: Nodes, places: Floats, out: Singles) -> None:
    for i in prange(len(places)):
        out[i] = density_at(nodes, places[i, 0], places[i, 1], places[i, 2])


@compiled(merged=True)
def density_at(nodes: Nodes, u: float, v: float, w: float) -> float:
    """Per world unit at a place in the box; 0 where the mask or `least` says so.

    The tuple is named in the first two lines alone: behind each branch numba counts who refers to its arrays, which
    took half of a sample's 90 ns.
    """
    kind, shift, scale, least = nodes.kind, nodes.shift, nodes.scale, nodes.least
    held, total = _raw(nodes, u, v, w) if _counts(nodes, u, v, w) else (False, 0.0)
    found = scale * _activated(kind, total + shift) if held else 0.0
    return found if found > least else 0.0


@compiled(merged=True)
def _counts(nodes: Nodes, u: float, v: float, w: float) -> bool:
    """Whether the mask says that there may be something at a place."""
    A, B, C = nodes.mask.shape
    a = u * nodes.times[0] + nodes.plus[0]
    b = v * nodes.times[1] + nodes.plus[1]
    c = w * nodes.times[2] + nodes.plus[2]
    inside = (a >= 0) & (a <= A) & (b >= 0) & (b <= B) & (c >= 0) & (c <= C)
    i, j, k = min(max(int(a), 0), A - 1), min(max(int(b), 0), B - 1), min(max(int(c), 0), C - 1)
    return bool(inside & nodes.mask[i, j, k])


@compiled(merged=True)
def _raw(nodes: Nodes, u: float, v: float, w: float) -> tuple[bool, float]:
    """Whether there is any value around a place, and what is between them."""
    return raw_at(nodes, u, v, w) if nodes.edge > 0 else _linked(nodes, u, v, w)


@compiled()
def _activated(kind: int, raw: float) -> float:
    if kind == RELU:
        return max(raw, 0.0)
    if kind == SOFTPLUS:
        return softplus_of(raw)
    if kind == EXPONENTIAL:
        whole, rest = _exp_parts(raw)
        return float(whole + whole * rest)
    return thickness_of(raw)


@compiled(merged=True)
def _linked(nodes: Nodes, u: float, v: float, w: float) -> tuple[bool, float]:
    """Whether any node around a place has a value, and what is between them."""
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


@compiled(parallel=True)
def _blended(links: npt.NDArray[np.int32], table: Singles, at: Floats, out: Singles) -> None:
    X, Y, Z = links.shape
    for n in prange(len(at)):
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
    """The node below a place, and how far it is from there to the next one: 0 to 1."""
    at = min(max(at, 0.0), count - 1.0)
    low = int(at)
    return low, at - low


@compiled()
def softplus_of(x: float) -> float:
    """ln(1 + e^x): of e = e^-|x| the series of 2 artanh(e / (2 + e)), exact in its last digits where e is small."""
    whole, rest = _exp_parts(-abs(x))
    small = whole + whole * rest
    s = small / (2 + small)
    z = s * s
    series = 1 / 33
    for n in range(31, 0, -2):
        series = series * z + 1 / n
    return float(max(x, 0.0) + 2 * s * series)


@compiled()
def thickness_of(opacity: float) -> float:
    """-ln(1 - x), of an opacity of at most 1 - 1/510: what is left is brought near 1, and there 2 artanh's series."""
    left, doubled = max(1 - max(opacity, 0.0), _LEAST_LEFT), 0.0
    while left < 0.7071067811865476:
        left, doubled = left * 2, doubled + 1
    s = (left - 1) / (left + 1)
    z = s * s
    series = 1 / 19
    for n in range(17, 0, -2):
        series = series * z + 1 / n
    return float(doubled * _LN2 - 2 * s * series)
