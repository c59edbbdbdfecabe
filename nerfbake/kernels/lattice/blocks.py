"""Lattices whose nodes are stored in blocks, plus three planes: interpolation of both, and weighted means of rows.

A block has `edge` cells along each axis and stores all nodes of these cells, including those on its faces, so
interpolation needs no other block. A plane spans two axes: plane 0 y and z, plane 1 x and z, plane 2 x and y. The
values of the planes are added to those of the nodes. Positions are fractions of the lattice's box, as in
kernels.lattice.nodes.
Source: MERF (Reiser et al., 2023).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Singles
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.parallel import on_every_core


def weighted_means(values: Singles, weights: Floats, group: int) -> Singles:
    """(k, C) weighted means over groups of consecutive rows: values (k group, C), weights (k group,).

    Sums run from a group's first row to its last. A group whose weights are all 0 has the mean 0.
    """
    out = np.empty((len(values) // group, values.shape[1]), np.float32)
    _means(values, weights, group, out)
    return out


@on_every_core
@compiled()
def _means(core: int, cores: int, values: Singles, weights: Floats, group: int, out: Singles) -> None:
    begin, end = part_of(len(out), core, cores)
    for k in range(begin, end):
        whole = 0.0
        for row in range(k * group, (k + 1) * group):
            whole += weights[row]
        for column in range(out.shape[1]):
            total = 0.0
            for row in range(k * group, (k + 1) * group):
                total += weights[row] * values[row, column]
            out[k, column] = total / whole if whole > 0 else 0.0


_FAR = 1e6  # largest number of steps that are skipped at once
_ROUNDING = 1e-3  # of a step: rounding may move a position into another block
_AT_ONCE = 1 << 10  # positions that a core processes before it takes the next part


class BlockNodes(NamedTuple):
    """The blocks of a lattice, and its transforms from positions.

    links (X, Y, Z): the row of a block's first node, followed by its other nodes, x-major; below 0 the block is empty.
    A position u is in block number int(u block_times + block_plus) along each axis, `edge` cells wide. In nodes of the
    planes it is at u plane_times + plane_plus.
    """

    links: npt.NDArray[np.int32]
    edge: int
    block_times: Floats
    block_plus: Floats
    plane_times: float
    plane_plus: float


NOWHERE = np.zeros(3)  # for a lattice without blocks
NO_PLANES = np.zeros((3, 0, 0), np.float32)


def sums_at(blocks: BlockNodes, table: Singles, planes: Singles, places: Floats) -> Singles:
    """(m, C) sums of the values of nodes and planes, interpolated at positions (m, 3); zeros in empty blocks.

    table (n, C): values of the nodes; planes (3, P, P, C): values of the planes.
    """
    out = np.zeros((len(places), table.shape[1]), np.float32)
    _sums(blocks, table, planes, places, out)
    return out


@compiled(merged=True)
def _place_in(blocks: Any, u: float, v: float, w: float) -> tuple[int, float, float, float]:
    """The row of the block's first node, below 0 for an empty block; and the position in the block, 0 to `edge` nodes.

    blocks: BlockNodes, or DensityNodes of kernels.lattice.nodes, which has the same fields.
    """
    X, Y, Z = blocks.links.shape
    a = u * blocks.block_times[0] + blocks.block_plus[0]
    b = v * blocks.block_times[1] + blocks.block_plus[1]
    c = w * blocks.block_times[2] + blocks.block_plus[2]
    i, j, k = min(max(int(a), 0), X - 1), min(max(int(b), 0), Y - 1), min(max(int(c), 0), Z - 1)
    return blocks.links[i, j, k], (a - i) * blocks.edge, (b - j) * blocks.edge, (c - k) * blocks.edge


@compiled(merged=True)
def _cell(at: float, cells: int) -> tuple[int, float]:
    """The cell that contains a position, and the position in the cell, 0 to 1."""
    low = min(max(int(at), 0), cells - 1)
    return low, min(max(at - low, 0.0), 1.0)


@compiled(merged=True)
def raw_at(nodes: Any, u: float, v: float, w: float) -> tuple[bool, float]:
    """Whether there is a block at a position, and the sum of the density (n,) and the planes (3, P, P) there.

    nodes: DensityNodes of kernels.lattice.nodes.
    """
    row, x, y, z = _place_in(nodes, u, v, w)
    if row < 0:
        return False, 0.0
    side = nodes.edge + 1
    i, fx = _cell(x, nodes.edge)
    j, fy = _cell(y, nodes.edge)
    k, fz = _cell(z, nodes.edge)
    total = 0.0
    for corner in range(8):
        share = (fx if corner & 4 else 1 - fx) * (fy if corner & 2 else 1 - fy) * (fz if corner & 1 else 1 - fz)
        at = ((i + (corner >> 2)) * side + j + (corner >> 1 & 1)) * side + k + (corner & 1)
        total += share * nodes.density[row + at]
    cells = nodes.planes.shape[1] - 1
    if cells > 0:
        i, fx = _cell(u * nodes.plane_times + nodes.plane_plus, cells)
        j, fy = _cell(v * nodes.plane_times + nodes.plane_plus, cells)
        k, fz = _cell(w * nodes.plane_times + nodes.plane_plus, cells)
        for corner in range(4):
            p, q = corner >> 1, corner & 1
            gx, gy = (fx if p else 1 - fx), (fy if p else 1 - fy)
            hy, hz = (fy if q else 1 - fy), (fz if q else 1 - fz)
            total += gy * hz * nodes.planes[0, j + p, k + q]
            total += gx * hz * nodes.planes[1, i + p, k + q]
            total += gx * hy * nodes.planes[2, i + p, j + q]
    return True, total


@compiled(merged=True)
def empty_steps(nodes: Any, u: float, v: float, w: float, du: float, dv: float, dw: float) -> int:
    """Number of steps (du, dv, dw) from a position that stay in the same empty block; 1 if the block is not empty."""
    left = 0.0
    if _place_in(nodes, u, v, w)[0] < 0:
        along_x = _steps_in(u * nodes.block_times[0] + nodes.block_plus[0], du * nodes.block_times[0])
        along_y = _steps_in(v * nodes.block_times[1] + nodes.block_plus[1], dv * nodes.block_times[1])
        along_z = _steps_in(w * nodes.block_times[2] + nodes.block_plus[2], dw * nodes.block_times[2])
        left = min(along_x, along_y, along_z)
    return max(int(left - _ROUNDING), 1)


@compiled(merged=True)
def _steps_in(at: float, step: float) -> float:
    """Number of steps from `at` to the end of its block, whose number is int(at)."""
    inside = at - int(at)
    return min((1 - inside) / step if step > 0 else inside / -step if step < 0 else _FAR, _FAR)


@on_every_core
@compiled()
def _sums(
    core: int, cores: int, blocks: BlockNodes, table: Singles, planes: Singles, places: Floats, out: Singles
) -> None:
    blocks, table, planes, places, out = borrowed((blocks, table, planes, places, out))
    m, C = out.shape
    side, cells = blocks.edge + 1, planes.shape[1] - 1
    for part in range(core, (m + _AT_ONCE - 1) // _AT_ONCE, cores):
        total = np.zeros(C)
        for n in range(part * _AT_ONCE, min((part + 1) * _AT_ONCE, m)):
            u, v, w = places[n, 0], places[n, 1], places[n, 2]
            row, x, y, z = _place_in(blocks, u, v, w)
            if row < 0:
                continue
            total[:] = 0
            i, fx = _cell(x, blocks.edge)
            j, fy = _cell(y, blocks.edge)
            k, fz = _cell(z, blocks.edge)
            for corner in range(8):
                share = (fx if corner & 4 else 1 - fx) * (fy if corner & 2 else 1 - fy) * (fz if corner & 1 else 1 - fz)
                at = row + ((i + (corner >> 2)) * side + j + (corner >> 1 & 1)) * side + k + (corner & 1)
                for column in range(C):
                    total[column] += share * table[at, column]
            if cells > 0:
                i, fx = _cell(u * blocks.plane_times + blocks.plane_plus, cells)
                j, fy = _cell(v * blocks.plane_times + blocks.plane_plus, cells)
                k, fz = _cell(w * blocks.plane_times + blocks.plane_plus, cells)
                _add_between(total, planes, 0, j, fy, k, fz)
                _add_between(total, planes, 1, i, fx, k, fz)
                _add_between(total, planes, 2, i, fx, j, fy)
            for column in range(C):
                out[n, column] = total[column]


@compiled(merged=True)
def _add_between(total: Floats, planes: Singles, plane: int, i: int, f: float, j: int, g: float) -> None:
    for corner in range(4):
        p, q = corner >> 1, corner & 1
        share = (f if p else 1 - f) * (g if q else 1 - g)
        for column in range(len(total)):
            total[column] += share * planes[plane, i + p, j + q, column]
