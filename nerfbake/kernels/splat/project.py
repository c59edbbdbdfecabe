"""Project splats to a picture: a row of numbers for each splat that may be visible, in the order of depth.

Source: Kerbl et al., "3D Gaussian Splatting" (2023), with the numbers of gsplat; docs/conventions.md, "How a picture of
splats is made".
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Singles, f32
from nerfbake.kernels.compiled import compiled_fill_basis
from nerfbake.kernels.jit import compiled
from nerfbake.kernels.parallel import on_every_core

NEAR = 0.01  # smallest distance along the optical axis, in world units
BLUR = 0.3  # added to the variances in the picture, in square pixels
SEEN = 1 / 255  # smallest alpha that is blended
LEAST_SHARE = 2.5e-5  # smallest quotient of the determinants without and with BLUR
# Columns of a row. The position is a whole number of pixels and a remainder, so that large pictures stay exact.
X, X_REST, Y, Y_REST, XX, XY, YY, OPACITY, RED, GREEN, BLUE, DEPTH, REACH, INVERSE_DET, HALF_WIDTH, HALF_HEIGHT = range(
    16
)
COLUMNS = 16  # 64 bytes: a line of the cache
_CHUNK = 2048  # splats of a task
_RADIX = 11  # bits
_LN2 = 0.6931471805599454  # rounded up


class Eye(NamedTuple):
    """A camera for splats. Axes: x right, y down, z forward.

    origin (3,); turn (3, 3): from the world to the camera. gram (3, 3): the products of the camera's axes, the unit
    matrix for a rotation. fx, fy, cx, cy: in pixels. limits (4,): least and largest x / z, least and largest y / z in
    the Jacobian. bounds (4,): left, top, right, bottom of the picture, in pixels.
    """

    origin: Floats
    turn: Floats
    gram: Floats
    fx: float
    fy: float
    cx: float
    cy: float
    limits: Floats
    bounds: Floats


class SplatArrays(NamedTuple):
    """means (n, 3), scales (n, 3), quats (n, 4), opacity (n,), sh (n, B, 3): the arrays of Splats."""

    means: Singles
    scales: Singles
    quats: Singles
    opacity: Singles
    sh: Singles


def project(splats: SplatArrays, eye: Eye, antialiased: bool) -> tuple[Singles, npt.NDArray[np.int32]]:
    """Return a row (m, COLUMNS) for each splat that reaches into the picture, nearest first, and their numbers (m,).

    Splats of equal depth (float32) keep their order. XX, XY, YY: the inverse of the covariance. REACH: twice the
    exponent at which alpha falls below SEEN. HALF_WIDTH, HALF_HEIGHT: of the box in which alpha reaches SEEN. REACH and
    what depends on it are upper bounds.
    """
    n = len(splats.means)
    rows, keys = np.empty((n, COLUMNS), np.float32), np.empty(n, np.float32)
    _project(splats, eye, antialiased, rows, keys)
    order = sort_by_depth(keys)
    sorted_rows = np.empty((len(order), COLUMNS), np.float32)
    _gather(rows, order, sorted_rows)
    return sorted_rows, order


def order_by_depth(means: Singles, eye: Eye) -> npt.NDArray[np.int32]:
    """Return the numbers of the splats beyond NEAR, nearest first: in the order of the rows of project()."""
    keys = np.empty(len(means), np.float32)
    _measure_depths(means, eye, keys)
    return sort_by_depth(keys)


@on_every_core
@compiled()
def _measure_depths(core: int, cores: int, means: Singles, eye: Eye, keys: Singles) -> None:
    n, turn = len(means), eye.turn
    for chunk in range(core, (n + _CHUNK - 1) // _CHUNK, cores):
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            dx = np.float64(means[i, 0]) - eye.origin[0]
            dy = np.float64(means[i, 1]) - eye.origin[1]
            dz = np.float64(means[i, 2]) - eye.origin[2]
            z = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
            keys[i] = z if z > NEAR else 0.0


@on_every_core
@compiled()
def _project(
    core: int, cores: int, splats: SplatArrays, eye: Eye, antialiased: bool, rows: Singles, keys: Singles
) -> None:
    """Write the rows. A key is the depth, or 0 for a splat that is not visible."""
    n = len(splats.means)
    basis = np.empty(splats.sh.shape[1])
    for chunk in range(core, (n + _CHUNK - 1) // _CHUNK, cores):
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)):
            keys[i] = f32(0)
            if _project_one(splats, eye, antialiased, i, rows):
                keys[i] = rows[i, DEPTH]
                _shade(splats, eye, i, basis, rows)


@compiled(merged=True)
def _project_one(splats: SplatArrays, eye: Eye, antialiased: bool, i: int, rows: Singles) -> bool:
    """Write all of a row but its colour. Returns whether the splat reaches into the picture."""
    opacity = np.float64(splats.opacity[i])
    turn = eye.turn
    dx = np.float64(splats.means[i, 0]) - eye.origin[0]
    dy = np.float64(splats.means[i, 1]) - eye.origin[1]
    dz = np.float64(splats.means[i, 2]) - eye.origin[2]
    z = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
    if not z > NEAR or not opacity >= SEEN:
        return False
    x = (turn[0, 0] * dx + turn[0, 1] * dy + turn[0, 2] * dz) / z
    y = (turn[1, 0] * dx + turn[1, 1] * dy + turn[1, 2] * dz) / z
    xx, xy, yy = picture_covariance(splats.scales, splats.quats, i, eye, x, y, z)
    sharp = max(xx * yy - xy * xy, 0.0)
    det = sharp + BLUR * (xx + yy) + BLUR * BLUR
    xx, yy = xx + BLUR, yy + BLUR
    if antialiased:
        opacity *= sqrt(max(LEAST_SHARE, sharp / det))
        if not opacity >= SEEN:
            return False
    reach = 2 * log_above(255 * opacity)
    wide, high = sqrt(reach * xx), sqrt(reach * yy)
    x, y = eye.fx * x + eye.cx, eye.fy * y + eye.cy
    if not (x + wide > eye.bounds[0] and x - wide < eye.bounds[2]):
        return False
    if not (y + high > eye.bounds[1] and y - high < eye.bounds[3]):
        return False
    rows[i, X], rows[i, Y] = np.floor(x), np.floor(y)
    rows[i, X_REST], rows[i, Y_REST] = x - np.floor(x), y - np.floor(y)
    rows[i, XX], rows[i, XY], rows[i, YY] = yy / det, -xy / det, xx / det
    rows[i, OPACITY], rows[i, DEPTH], rows[i, REACH], rows[i, INVERSE_DET] = opacity, z, reach, 1 / det
    rows[i, HALF_WIDTH], rows[i, HALF_HEIGHT] = wide, high
    return True


@compiled(merged=True)
def picture_covariance(
    scales: Singles, quats: Singles, i: int, eye: Eye, x: float, y: float, z: float
) -> tuple[float, float, float]:
    """Return xx, xy, yy in square pixels, without BLUR. x, y: of the centre, at distance 1; z: its depth."""
    u0, u1, u2, v0, v1, v2 = picture_rows(eye, x, y, z)
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = axes_of(quats, i)
    s0, s1, s2 = np.float64(scales[i, 0]), np.float64(scales[i, 1]), np.float64(scales[i, 2])
    p0, q0 = s0 * (u0 * r00 + u1 * r01 + u2 * r02), s0 * (v0 * r00 + v1 * r01 + v2 * r02)
    p1, q1 = s1 * (u0 * r10 + u1 * r11 + u2 * r12), s1 * (v0 * r10 + v1 * r11 + v2 * r12)
    p2, q2 = s2 * (u0 * r20 + u1 * r21 + u2 * r22), s2 * (v0 * r20 + v1 * r21 + v2 * r22)
    return p0 * p0 + p1 * p1 + p2 * p2, p0 * q0 + p1 * q1 + p2 * q2, q0 * q0 + q1 * q1 + q2 * q2


@compiled(merged=True)
def picture_rows(eye: Eye, x: float, y: float, z: float) -> tuple[float, float, float, float, float, float]:
    """Return the two rows of J W, for J the Jacobian of the projection. x, y, z: as in picture_covariance()."""
    turn, fx, fy = eye.turn, eye.fx / z, eye.fy / z
    x, y = min(max(x, eye.limits[0]), eye.limits[1]), min(max(y, eye.limits[2]), eye.limits[3])
    return (
        fx * (turn[0, 0] - x * turn[2, 0]),
        fx * (turn[0, 1] - x * turn[2, 1]),
        fx * (turn[0, 2] - x * turn[2, 2]),
        fy * (turn[1, 0] - y * turn[2, 0]),
        fy * (turn[1, 1] - y * turn[2, 1]),
        fy * (turn[1, 2] - y * turn[2, 2]),
    )


@compiled(merged=True)
def axes_of(quats: Singles, i: int) -> tuple[float, float, float, float, float, float, float, float, float]:
    """Return the axes of a splat, the columns of its rotation, one after the other."""
    w, a, b, c = np.float64(quats[i, 0]), np.float64(quats[i, 1]), np.float64(quats[i, 2]), np.float64(quats[i, 3])
    return (
        1 - 2 * (b * b + c * c),
        2 * (a * b + w * c),
        2 * (a * c - w * b),
        2 * (a * b - w * c),
        1 - 2 * (a * a + c * c),
        2 * (b * c + w * a),
        2 * (a * c + w * b),
        2 * (b * c - w * a),
        1 - 2 * (a * a + b * b),
    )


@compiled(merged=True)
def _shade(splats: SplatArrays, eye: Eye, i: int, basis: Floats, rows: Singles) -> None:
    """Write the colour of a splat, for the direction from the camera to its centre."""
    dx = np.float64(splats.means[i, 0]) - eye.origin[0]
    dy = np.float64(splats.means[i, 1]) - eye.origin[1]
    dz = np.float64(splats.means[i, 2]) - eye.origin[2]
    per = 1 / sqrt(dx * dx + dy * dy + dz * dz)
    compiled_fill_basis(dx * per, dy * per, dz * per, len(basis), basis)
    red, green, blue = 0.5, 0.5, 0.5
    for k in range(len(basis)):
        red += basis[k] * splats.sh[i, k, 0]
        green += basis[k] * splats.sh[i, k, 1]
        blue += basis[k] * splats.sh[i, k, 2]
    rows[i, RED], rows[i, GREEN], rows[i, BLUE] = max(red, 0.0), max(green, 0.0), max(blue, 0.0)


@compiled(merged=True)
def log_above(x: float) -> float:
    """An upper bound of ln x, at most 1 % above it, for x in 1 to 255."""
    halvings = 0
    while x > 2:
        x *= 0.5
        halvings += 1
    # ln x <= (x - 1) (x + 5) / (4 x + 2) for x above 1: the Pade approximant at 1.
    return max(halvings * _LN2 + (x - 1) * (x + 5) / (4 * x + 2), 0.0)


def sort_by_depth(keys: Singles) -> npt.NDArray[np.int32]:
    """Return the indices of the keys above 0 in ascending order; equal keys keep their order."""
    order = np.flatnonzero(keys > 0).astype(np.int32)
    # Positive floats are in the order of their bits.
    words, spare = keys.view(np.uint32)[order], np.empty((2, len(order)), np.uint32)
    _radix_sort(words, order, spare[0], spare[1].view(np.int32))
    return order


@compiled()
def _radix_sort(
    words: npt.NDArray[np.uint32],
    order: npt.NDArray[np.int32],
    other_words: npt.NDArray[np.uint32],
    other_order: npt.NDArray[np.int32],
) -> None:
    """Sort by 3 x 11 bits, the lowest first. The result is in `order`."""
    n, size = len(words), 1 << _RADIX
    for round_ in range(3):
        counts = np.zeros(size + 1, np.int64)
        shift = np.uint32(_RADIX * round_)
        for i in range(n):
            counts[(words[i] >> shift & np.uint32(size - 1)) + 1] += 1
        for k in range(size):
            counts[k + 1] += counts[k]
        for i in range(n):
            digit = words[i] >> shift & np.uint32(size - 1)
            at = counts[digit]
            counts[digit] = at + 1
            other_words[at], other_order[at] = words[i], order[i]
        words, other_words = other_words, words
        order, other_order = other_order, order
    # An odd number of rounds: the result is in the spare array.
    for i in range(n):
        other_order[i] = order[i]


@on_every_core
@compiled()
def _gather(core: int, cores: int, rows: Singles, order: npt.NDArray[np.int32], out: Singles) -> None:
    m = len(order)
    for chunk in range(core, (m + _CHUNK - 1) // _CHUNK, cores):
        for i in range(chunk * _CHUNK, min((chunk + 1) * _CHUNK, m)):
            for k in range(COLUMNS):
                out[i, k] = rows[order[i], k]
