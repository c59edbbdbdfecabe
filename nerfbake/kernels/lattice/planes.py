"""Lattices that are sums of products: of a plane across two axes and a line along the third one.

A node's value is the sum over i and r of plane_i[.., .., r] line_i[.., r] matrix[i r, c]: plane 0 lies across x and y,
plane 1 across x and z, plane 2 across y and z. Trilinear values between the nodes are the product of bilinear and
linear ones, so that nothing is lost by working the nodes out. Source: TensoRF (Chen et al., 2022), 4.1.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from numba import prange

from nerfbake.kernels.arrays import Singles
from nerfbake.kernels.jit import compiled


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
    """Writes the values of all nodes with a row, links (X, Y, Z), into out (n, C)."""
    _values(links, *factors, out)


@compiled(parallel=True)
def _values(
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
    for column in prange(X * Y):
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
