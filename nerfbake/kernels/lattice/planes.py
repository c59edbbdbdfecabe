"""Lattices that are sums of products of a plane across two axes and a line along the third; cells and nodes of masks.

The value of a node is the sum over i and r of plane_i[.., .., r] line_i[.., r] matrix[i r, c]: plane 0 spans x and y,
plane 1 x and z, plane 2 y and z. Trilinear values between the nodes are the product of bilinear and linear ones, so
computing the nodes first loses nothing. Source: TensoRF (Chen et al., 2022), 4.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Singles, as_input
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core


def touched_cells(nodes: Bits) -> Bits:
    """(X + 1, Y + 1, Z + 1) cells between nodes (X, Y, Z) and around them: those with a set node at a corner."""
    cells = np.pad(nodes, 1)
    for axis in range(3):
        ends = np.arange(nodes.shape[axis] + 1)
        cells = cells.take(ends, axis) | cells.take(ends + 1, axis)
    return cells


def nodes_around(cells: Bits, box: Floats, own: Floats, shape: tuple[int, int, int], *, at_corners: bool) -> Bits:
    """(X, Y, Z) the nodes of a lattice of this shape and box (2, 3) that values within the cells depend on.

    cells (A, B, C) divide another box, `own`. A node influences positions that are nearer than the distance of two
    nodes on every axis; a node whose range only touches a cell is included, too.
    """
    near = cells
    for axis, edge in enumerate(shape):
        count = cells.shape[axis]
        first = box[0, axis] if at_corners else box[0, axis] + (box[1, axis] - box[0, axis]) / edge / 2
        apart = (box[1, axis] - box[0, axis]) / (edge - at_corners)
        ends = first + apart * (np.arange(edge)[:, None] + (-1, 1))
        at = (ends - own[0, axis]) / (own[1, axis] - own[0, axis]) * count
        low, high = np.clip(np.floor(at[:, 0]), 0, count), np.clip(np.ceil(at[:, 1]), 0, count)
        before = np.zeros((*near.shape[:axis], 1, *near.shape[axis + 1 :]), np.int16)
        sums = np.concatenate([before, near.cumsum(axis, np.int16)], axis)
        near = sums.take(high.astype(np.int64), axis) > sums.take(low.astype(np.int64), axis)
    return near


class Factors(NamedTuple):
    """xy (X, Y, R), xz (X, Z, S), yz (Y, Z, T); z (Z, R), y (Y, S), x (X, T); matrix (R + S + T, C)."""

    xy: Singles
    xz: Singles
    yz: Singles
    z: Singles
    y: Singles
    x: Singles
    matrix: Singles


def values_of(links: npt.NDArray[np.int32], factors: Factors, out: Singles) -> None:
    """Write the values of all nodes that have a row, links (X, Y, Z), into out (n, C)."""
    _values(links, *Factors._make(map(as_input, factors)), out)


@on_every_core
@compiled()
def _values(
    core: int,
    cores: int,
    links: npt.NDArray[np.int32],
    xy: Singles,
    xz: Singles,
    yz: Singles,
    along_z: Singles,
    along_y: Singles,
    along_x: Singles,
    matrix: Singles,
    out: Singles,
) -> None:
    X, Y, Z = links.shape
    R, S, T = xy.shape[2], xz.shape[2], yz.shape[2]
    for column in range(core, X * Y, cores):
        x, y = column // Y, column % Y
        parts = np.empty(R + S + T, np.float32)
        for z in range(Z):
            row = links[x, y, z]
            if row < 0:
                continue
            for r in range(R):
                parts[r] = xy[x, y, r] * along_z[z, r]
            for r in range(S):
                parts[R + r] = xz[x, z, r] * along_y[y, r]
            for r in range(T):
                parts[R + S + r] = yz[y, z, r] * along_x[x, r]
            own = out[row]
            own[:] = 0
            for r in range(len(parts)):
                part, shares = parts[r], matrix[r]
                for c in range(len(own)):
                    own[c] += part * shares[c]
