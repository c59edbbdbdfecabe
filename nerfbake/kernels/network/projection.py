"""Fit spherical harmonics to colours in the directions in which cameras see a cell."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Coords, Floats, Ints, Singles
from nerfbake.kernels.compiled import compiled_fill_basis
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.parallel import on_every_core

_LEAST = 0.001  # weight of a direction from which a cell is not seen
_STEPS = np.array([128, 26, 1, 0])  # of the transmittance, 0 to 255: cameras that see a cell well come first
_BLOCK = 256  # cells that a core processes before it takes the next block


def choose_cameras(through: npt.NDArray[np.uint8], count: int) -> npt.NDArray[np.int32]:
    """Return for each cell (m, count) the cameras from which its colours are computed.

    through (C, m): the transmittance between each camera and the cell, 0 to 255. The cameras are in an order such that
    the first ones are far apart. Those that see the cell come first.
    """
    out = np.empty((through.shape[1], count), np.int32)
    _choose(through, _STEPS, out)
    return out


def fit_logits(
    logits: Singles, directions: Floats, through: npt.NDArray[np.uint8], ridge: Floats, out: Singles
) -> None:
    """Write the coefficients (m, 3 B) of the logits (m, k, 3) in k directions (m, k, 3) of each of m cells.

    through (m, k): the transmittance along each direction, 0 to 255. ridge (B,): added to the diagonal of the normal
    equations, whose weights are 1 for a direction without obstacle.
    """
    _fit(logits, directions, through, ridge, out)


@on_every_core
@compiled()
def _choose(core: int, cores: int, through: npt.NDArray[np.uint8], steps: Ints, out: Coords) -> None:
    through, out = borrowed((through, out))
    cameras, cells = through.shape
    count = out.shape[1]
    for block in range(core, (cells + _BLOCK - 1) // _BLOCK, cores):
        for cell in range(block * _BLOCK, min((block + 1) * _BLOCK, cells)):
            held, most = 0, 256
            for step in range(len(steps)):
                least = steps[step]
                for camera in range(cameras):
                    if held < count and least <= through[camera, cell] < most:
                        out[cell, held] = camera
                        held += 1
                most = least


@on_every_core
@compiled()
def _fit(
    core: int,
    cores: int,
    logits: Singles,
    directions: Floats,
    through: npt.NDArray[np.uint8],
    ridge: Floats,
    out: Singles,
) -> None:
    logits, directions, through, ridge, out = borrowed((logits, directions, through, ridge, out))
    cells, count, B = logits.shape[0], logits.shape[1], len(ridge)
    for block in range(core, (cells + _BLOCK - 1) // _BLOCK, cores):
        basis, left, right = np.empty(B), np.empty((B, B)), np.empty((B, 3))
        for cell in range(block * _BLOCK, min((block + 1) * _BLOCK, cells)):
            left[:], right[:] = 0.0, 0.0
            for k in range(B):
                left[k, k] = ridge[k]
            for d in range(count):
                weight = through[cell, d] * (1 / 255) + _LEAST
                compiled_fill_basis(directions[cell, d, 0], directions[cell, d, 1], directions[cell, d, 2], B, basis)
                for i in range(B):
                    part = weight * basis[i]
                    for j in range(i + 1):
                        left[i, j] += part * basis[j]
                    for c in range(3):
                        right[i, c] += part * logits[cell, d, c]
            _solve(left, right)
            for c in range(3):
                for k in range(B):
                    out[cell, c * B + k] = right[k, c]


@compiled(merged=True)
def _solve(left: Floats, right: Floats) -> None:
    """Solve left x = right in place by a Cholesky factorisation; of left, the lower triangle is used."""
    B, columns = right.shape
    for i in range(B):
        for j in range(i + 1):
            total = left[i, j]
            for k in range(j):
                total -= left[i, k] * left[j, k]
            left[i, j] = np.sqrt(total) if i == j else total / left[j, j]
    for c in range(columns):
        for i in range(B):
            for k in range(i):
                right[i, c] -= left[i, k] * right[k, c]
            right[i, c] /= left[i, i]
        for i in range(B - 1, -1, -1):
            for k in range(i + 1, B):
                right[i, c] -= left[k, i] * right[k, c]
            right[i, c] /= left[i, i]
