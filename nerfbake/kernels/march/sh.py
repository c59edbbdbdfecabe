"""Real spherical harmonics, in the order and with the signs of PlenOctrees.

Order: f0^0, f1^-1, f1^0, f1^1, f2^-2, ... Y1 is (-y, z, -x): the Condon-Shortley phase is kept, as in svox.
Source: docs/conventions.md, "Spherical harmonics".
"""

from __future__ import annotations

from math import pi, sqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.maths.affine import compose, inverse, rotate
from nerfbake.kernels.maths.elementary import fibonacci

_DIRECTIONS = 64  # of the fit in rotation_of_sh()
_DIGITS = 12  # of a rotation's entries: the rest is rounding, which would blur entries that are 0 or 1


def sh_basis(directions: npt.NDArray[np.float64], B: int, dtype: npt.DTypeLike = np.float64) -> npt.NDArray[Any]:
    """The first B (1, 4, 9, 16, 25) basis functions at unit directions: (m, 3) -> (m, B)."""
    out = np.empty((len(directions), B), dtype)
    fill_basis(directions[:, 0], directions[:, 1], directions[:, 2], B, out.T)
    return out


def fill_basis(x: Any, y: Any, z: Any, B: int, out: npt.NDArray[Any]) -> None:
    """Write sh_basis() into out: (B, m) for arrays x, y, z (m,); in compiled code (B,) for numbers."""
    xx, yy, zz = x * x, y * y, z * z
    out[0] = 0.5 / sqrt(pi)
    if B > 1:
        k = sqrt(3 / (4 * pi))
        out[1], out[2], out[3] = -k * y, k * z, -k * x
    if B > 4:
        k = sqrt(15 / (4 * pi))
        out[4], out[5], out[7] = k * x * y, -k * y * z, -k * x * z
        out[6] = sqrt(5 / (16 * pi)) * (2 * zz - xx - yy)
        out[8] = k / 2 * (xx - yy)
    if B > 9:
        k0, k1, k2, k3 = sqrt(7 / (16 * pi)), sqrt(21 / (32 * pi)), sqrt(105 / (16 * pi)), sqrt(35 / (32 * pi))
        side = 4 * zz - xx - yy
        out[9], out[15] = -k3 * y * (3 * xx - yy), -k3 * x * (xx - 3 * yy)
        out[10], out[14] = 2 * k2 * x * y * z, k2 * z * (xx - yy)
        out[11], out[13] = -k1 * y * side, -k1 * x * side
        out[12] = k0 * z * (2 * zz - 3 * xx - 3 * yy)
    if B > 16:
        k0, k1, k2 = 3 / (16 * sqrt(pi)), 3 * sqrt(5 / (32 * pi)), 3 * sqrt(5 / (64 * pi))
        k3, k4 = 3 * sqrt(35 / (32 * pi)), 3 * sqrt(35 / (256 * pi))
        out[16], out[24] = 4 * k4 * x * y * (xx - yy), k4 * (xx * (xx - 3 * yy) - yy * (3 * xx - yy))
        out[17], out[23] = -k3 * y * z * (3 * xx - yy), -k3 * x * z * (xx - 3 * yy)
        out[18], out[22] = 2 * k2 * x * y * (7 * zz - 1), k2 * (xx - yy) * (7 * zz - 1)
        out[19], out[21] = -k1 * y * z * (7 * zz - 3), -k1 * x * z * (7 * zz - 3)
        out[20] = k0 * (zz * (35 * zz - 30) + 3)


def band_of(B: int) -> npt.NDArray[np.int64]:
    """(B,) the band l of each basis function: 0, 1, 1, 1, 2, ..."""
    return np.floor(np.sqrt(np.arange(B))).astype(np.int64)


def rotation_of_sh(matrix: npt.NDArray[np.float64], B: int) -> npt.NDArray[np.float64]:
    """(B, B) matrix that rotates coefficients along with their directions, for an orthogonal (3, 3) matrix.

    The rotated coefficients have at the direction `matrix @ d` the value that the others have at d. Bands do not mix.
    Solved from the basis in more directions than it has functions, so that it holds for any order and signs.
    """
    directions = fibonacci(_DIRECTIONS)
    after, before = sh_basis(directions, B), sh_basis(rotate(directions, np.ascontiguousarray(matrix.T)), B)
    out, bands = np.zeros((B, B)), band_of(B)
    for band in range(int(bands[-1]) + 1):
        own = np.flatnonzero(bands == band)
        own_after, own_before = after[:, own], before[:, own]
        squares = (own_after[:, :, None] * own_after[:, None, :]).sum(axis=0)
        mixed = (own_after[:, :, None] * own_before[:, None, :]).sum(axis=0)
        out[np.ix_(own, own)] = compose(inverse(squares), mixed)
    return np.round(out, _DIGITS) + 0.0
