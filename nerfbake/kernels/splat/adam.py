"""Gradients of splats from the sums of a picture's tiles, and the steps of Adam along them."""

from __future__ import annotations

from math import sqrt
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles, f32
from nerfbake.kernels.compiled import compiled_fill_basis
from nerfbake.kernels.jit import borrowed, compiled
from nerfbake.kernels.maths.elementary import exp, log
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.splat.backward import SUMS
from nerfbake.kernels.splat.project import (
    BLUE,
    BLUR,
    GREEN,
    LEAST_SHARE,
    RED,
    Eye,
    SplatArrays,
    axes_of,
    picture_rows,
)

# Columns of a gradient: with respect to the mean, the logarithms of the scales, the quaternion, the logit of the
# opacity, and the SH coefficients (B, 3).
MEAN, SCALE, QUAT, OPACITY, SH = 0, 3, 6, 10, 11
_BETA1, _BETA2 = 0.9, 0.999
_EPSILON = 1e-15
_FADES = 10_000  # steps after which the factors are 1
_CHUNK = 1024  # splats of a task

Triple = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


class Entries(NamedTuple):
    """The sums of blend_back(), with the entries of each row from entries_by_row()."""

    sums: Singles
    firsts: Ints
    places: npt.NDArray[np.int32]


class Moments(NamedTuple):
    """Adam's moving means (n, 11 + 3 B) of gradients and of their squares, and the number of steps (n,) so far.

    fades (k, 2): the factors that correct the means after so many steps for their start at 0; the last ones are 1.
    """

    first: Singles
    second: Singles
    steps: npt.NDArray[np.int32]
    fades: Floats


class StepSizes(NamedTuple):
    """mean: in the splat's mean scale; scale, quat, opacity: of the parameters; sh (B,): of each coefficient."""

    mean: float
    scale: float
    quat: float
    opacity: float
    sh: Floats


def new_moments(splats: SplatArrays) -> Moments:
    """Return the moments before the first step."""
    shape = len(splats.means), SH + 3 * splats.sh.shape[1]
    fades = np.ones((_FADES, 2))
    count = np.arange(1, _FADES - 1)
    for column, beta in enumerate((_BETA1, _BETA2)):
        fades[1:-1, column] = 1 / (1 - exp(count * log(beta)))
    return Moments(np.zeros(shape, np.float32), np.zeros(shape, np.float32), np.zeros(shape[0], np.int32), fades)


def take_steps(
    splats: SplatArrays,
    eye: Eye,
    antialiased: bool,
    rows: Singles,
    order: npt.NDArray[np.int32],
    entries: Entries,
    moments: Moments,
    sizes: StepSizes,
) -> None:
    """Change the splats that the picture shows by a step of Adam. The others stay as they are."""
    # In the order of the splats: in that of depth, loading the moments took three times as long as computing them.
    row_of = np.full(len(splats.means), -1, np.int32)
    row_of[order] = np.arange(len(order), dtype=np.int32)
    _take_steps(splats, eye, antialiased, rows, row_of, entries, moments, sizes)


@on_every_core
@compiled()
def _take_steps(
    core: int,
    cores: int,
    splats: SplatArrays,
    eye: Eye,
    antialiased: bool,
    rows: Singles,
    row_of: npt.NDArray[np.int32],
    entries: Entries,
    moments: Moments,
    sizes: StepSizes,
) -> None:
    own, total, basis = np.zeros(moments.first.shape[1], np.float32), np.zeros(SUMS), np.zeros(splats.sh.shape[1])
    n = len(row_of)
    for chunk in range(core, (n + _CHUNK - 1) // _CHUNK, cores):
        part = chunk * _CHUNK, min((chunk + 1) * _CHUNK, n)
        _take_steps_of(part, splats, eye, antialiased, rows, row_of, entries, moments, sizes, own, total, basis)


@compiled()
def _take_steps_of(
    part: tuple[int, int],
    splats: SplatArrays,
    eye: Eye,
    antialiased: bool,
    rows: Singles,
    row_of: npt.NDArray[np.int32],
    entries: Entries,
    moments: Moments,
    sizes: StepSizes,
    own: Singles,
    total: Floats,
    basis: Floats,
) -> None:
    """Take the steps of the splats from part[0] to part[1]. own, total and basis are buffers."""
    splats, eye, rows, row_of = borrowed((splats, eye, rows, row_of))  # else each merged function counts references
    entries, moments, sizes, own, total, basis = borrowed((entries, moments, sizes, own, total, basis))
    for i in range(part[0], part[1]):
        row = row_of[i]
        if row >= 0 and _sum_entries(entries, row, total):
            _gradient(splats, eye, antialiased, rows, row, i, total, basis, own)
            _step(splats, i, own, moments, sizes)


@compiled(merged=True)
def _sum_entries(entries: Entries, row: int, total: Floats) -> bool:
    """Sum the entries of a row in their order. Returns whether a sum is not 0."""
    met = False
    for k in range(SUMS):
        total[k] = 0.0
    for at in range(entries.firsts[row], entries.firsts[row + 1]):
        place = entries.places[at]
        for k in range(SUMS):
            total[k] += entries.sums[place, k]
    for k in range(SUMS):
        met = met or total[k] != 0
    return met


@compiled(merged=True)
def _gradient(
    splats: SplatArrays,
    eye: Eye,
    antialiased: bool,
    rows: Singles,
    row: int,
    i: int,
    total: Floats,
    basis: Floats,
    out: Singles,
) -> None:
    """Write the gradient of a splat: the chain rule through kernels.splat.project, with the same names."""
    turn, whole = eye.turn, total[0]
    dx = np.float64(splats.means[i, 0]) - eye.origin[0]
    dy = np.float64(splats.means[i, 1]) - eye.origin[1]
    dz = np.float64(splats.means[i, 2]) - eye.origin[2]
    z = turn[2, 0] * dx + turn[2, 1] * dy + turn[2, 2] * dz
    x = (turn[0, 0] * dx + turn[0, 1] * dy + turn[0, 2] * dz) / z
    y = (turn[1, 0] * dx + turn[1, 1] * dy + turn[1, 2] * dz) / z
    u0, u1, u2, v0, v1, v2 = picture_rows(eye, x, y, z)
    w, a, b, c = (
        np.float64(splats.quats[i, 0]),
        np.float64(splats.quats[i, 1]),
        np.float64(splats.quats[i, 2]),
        np.float64(splats.quats[i, 3]),
    )
    s0, s1, s2 = np.float64(splats.scales[i, 0]), np.float64(splats.scales[i, 1]), np.float64(splats.scales[i, 2])
    r00, r01, r02, r10, r11, r12, r20, r21, r22 = axes_of(splats.quats, i)
    p0, q0 = s0 * (u0 * r00 + u1 * r01 + u2 * r02), s0 * (v0 * r00 + v1 * r01 + v2 * r02)
    p1, q1 = s1 * (u0 * r10 + u1 * r11 + u2 * r12), s1 * (v0 * r10 + v1 * r11 + v2 * r12)
    p2, q2 = s2 * (u0 * r20 + u1 * r21 + u2 * r22), s2 * (v0 * r20 + v1 * r21 + v2 * r22)
    sharp_xx, sharp_xy, sharp_yy = p0 * p0 + p1 * p1 + p2 * p2, p0 * q0 + p1 * q1 + p2 * q2, q0 * q0 + q1 * q1 + q2 * q2
    xx, xy, yy, hxx, hxy, hyy = _covariance_slopes(sharp_xx, sharp_xy, sharp_yy, total, antialiased)
    dp0, dq0 = 2 * (hxx * p0 + hxy * q0), 2 * (hxy * p0 + hyy * q0)
    dp1, dq1 = 2 * (hxx * p1 + hxy * q1), 2 * (hxy * p1 + hyy * q1)
    dp2, dq2 = 2 * (hxx * p2 + hxy * q2), 2 * (hxy * p2 + hyy * q2)
    out[SCALE], out[SCALE + 1], out[SCALE + 2] = dp0 * p0 + dq0 * q0, dp1 * p1 + dq1 * q1, dp2 * p2 + dq2 * q2
    dp0, dq0, dp1, dq1, dp2, dq2 = s0 * dp0, s0 * dq0, s1 * dp1, s1 * dq1, s2 * dp2, s2 * dq2
    d00, d01, d02 = dp0 * u0 + dq0 * v0, dp0 * u1 + dq0 * v1, dp0 * u2 + dq0 * v2
    d10, d11, d12 = dp1 * u0 + dq1 * v0, dp1 * u1 + dq1 * v1, dp1 * u2 + dq1 * v2
    d20, d21, d22 = dp2 * u0 + dq2 * v0, dp2 * u1 + dq2 * v1, dp2 * u2 + dq2 * v2
    _write_quaternion_slopes((w, a, b, c), (d00, d01, d02), (d10, d11, d12), (d20, d21, d22), out)
    out[OPACITY] = whole * (1 - np.float64(splats.opacity[i]))
    # The rows of J W, then the centre.
    du0, du1, du2 = (
        dp0 * r00 + dp1 * r10 + dp2 * r20,
        dp0 * r01 + dp1 * r11 + dp2 * r21,
        dp0 * r02 + dp1 * r12 + dp2 * r22,
    )
    dv0, dv1, dv2 = (
        dq0 * r00 + dq1 * r10 + dq2 * r20,
        dq0 * r01 + dq1 * r11 + dq2 * r21,
        dq0 * r02 + dq1 * r12 + dq2 * r22,
    )
    gx = eye.fx * (xx * total[1] + xy * total[2])
    gy = eye.fy * (xy * total[1] + yy * total[2])
    gz = -(du0 * u0 + du1 * u1 + du2 * u2 + dv0 * v0 + dv1 * v1 + dv2 * v2) / z
    if eye.limits[0] <= x <= eye.limits[1]:
        gx -= eye.fx / z * (du0 * turn[2, 0] + du1 * turn[2, 1] + du2 * turn[2, 2])
    if eye.limits[2] <= y <= eye.limits[3]:
        gy -= eye.fy / z * (dv0 * turn[2, 0] + dv1 * turn[2, 1] + dv2 * turn[2, 2])
    gz -= (gx * x + gy * y) / z
    gx, gy = gx / z, gy / z
    for k in range(3):
        out[MEAN + k] = gx * turn[0, k] + gy * turn[1, k] + gz * turn[2, k]
    per = 1 / sqrt(dx * dx + dy * dy + dz * dz)
    compiled_fill_basis(dx * per, dy * per, dz * per, len(basis), basis)
    _write_colour_slopes(rows, row, total, basis, out)


@compiled(merged=True)
def _covariance_slopes(sharp_xx: float, sharp_xy: float, sharp_yy: float, total: Floats, antialiased: bool) -> Any:
    """Return the inverse covariance K in the picture, and the slopes of the error along the sharp covariance.

    The error changes by -K g K with the covariance, for g that with K.
    """
    sharp = max(sharp_xx * sharp_yy - sharp_xy * sharp_xy, 0.0)
    det = sharp + BLUR * (sharp_xx + sharp_yy) + BLUR * BLUR
    xx, xy, yy = (sharp_yy + BLUR) / det, -sharp_xy / det, (sharp_xx + BLUR) / det
    gxx, gxy, gyy = -0.5 * total[3], -0.5 * total[4], -0.5 * total[5]
    kx0, kx1 = xx * gxx + xy * gxy, xx * gxy + xy * gyy
    ky0, ky1 = xy * gxx + yy * gxy, xy * gxy + yy * gyy
    hxx, hxy, hyy = -(kx0 * xx + kx1 * xy), -(kx0 * xy + kx1 * yy), -(ky0 * xy + ky1 * yy)
    if antialiased and sharp > LEAST_SHARE * det:
        half = 0.5 * total[0]
        hxx += half * (sharp_yy / sharp - xx)
        hxy += half * (-sharp_xy / sharp - xy)
        hyy += half * (sharp_xx / sharp - yy)
    return xx, xy, yy, hxx, hxy, hyy


@compiled(merged=True)
def _write_quaternion_slopes(quat: Quaternion, d0: Triple, d1: Triple, d2: Triple, out: Singles) -> None:
    """Write the slopes along a unit quaternion from those along the rows of its rotation."""
    (w, a, b, c), (d00, d01, d02), (d10, d11, d12), (d20, d21, d22) = quat, d0, d1, d2
    gw = 2 * (c * (d01 - d10) + b * (d20 - d02) + a * (d12 - d21))
    ga = 2 * (b * (d01 + d10) + c * (d02 + d20) + w * (d12 - d21) - 2 * a * (d11 + d22))
    gb = 2 * (a * (d01 + d10) + c * (d12 + d21) + w * (d20 - d02) - 2 * b * (d00 + d22))
    gc = 2 * (a * (d02 + d20) + b * (d12 + d21) + w * (d01 - d10) - 2 * c * (d00 + d11))
    along = gw * w + ga * a + gb * b + gc * c  # the length of a quaternion has no effect
    out[QUAT], out[QUAT + 1] = gw - along * w, ga - along * a
    out[QUAT + 2], out[QUAT + 3] = gb - along * b, gc - along * c


@compiled(merged=True)
def _write_colour_slopes(rows: Singles, row: int, total: Floats, basis: Floats, out: Singles) -> None:
    """Write the slopes along the coefficients; a channel that is clamped to 0 has none."""
    red = total[6] if rows[row, RED] > 0 else 0.0
    green = total[7] if rows[row, GREEN] > 0 else 0.0
    blue = total[8] if rows[row, BLUE] > 0 else 0.0
    for k in range(len(basis)):
        out[SH + 3 * k], out[SH + 3 * k + 1], out[SH + 3 * k + 2] = red * basis[k], green * basis[k], blue * basis[k]


@compiled(merged=True)
def _step(splats: SplatArrays, i: int, gradient: Singles, moments: Moments, sizes: StepSizes) -> None:
    """Replace the gradient by Adam's step, and take it."""
    count = moments.steps[i] + 1
    moments.steps[i] = count
    known = min(count, len(moments.fades) - 1)
    fade1, fade2 = moments.fades[known, 0], moments.fades[known, 1]
    beta1, beta2, new1, new2 = f32(_BETA1), f32(_BETA2), f32(1 - _BETA1), f32(1 - _BETA2)
    factor, square_factor, least = f32(-fade1), f32(fade2), f32(_EPSILON)
    splat = np.uint64(i)
    for k in range(np.uint64(gradient.size)):
        g = gradient[k]
        first = beta1 * moments.first[splat, k] + new1 * g
        second = beta2 * moments.second[splat, k] + new2 * g * g
        moments.first[splat, k], moments.second[splat, k] = first, second
        gradient[k] = factor * first / (np.sqrt(square_factor * second) + least)
    size = sizes.mean * (splats.scales[i, 0] + splats.scales[i, 1] + splats.scales[i, 2]) / 3
    for k in range(3):
        splats.means[i, k] += size * gradient[MEAN + k]
        splats.scales[i, k] *= exp_of_step(sizes.scale * gradient[SCALE + k])
    square = 0.0
    for k in range(4):
        part = splats.quats[i, k] + sizes.quat * gradient[QUAT + k]
        gradient[QUAT + k] = part
        square += part * part
    per = 1 / sqrt(square)
    for k in range(4):
        splats.quats[i, k] = gradient[QUAT + k] * per
    opacity = np.float64(splats.opacity[i])
    odds = (1 - opacity) / opacity * exp_of_step(-sizes.opacity * gradient[OPACITY])
    splats.opacity[i] = min(max(1 / (1 + odds), 1e-4), 1 - 1e-4)
    for k in range(len(sizes.sh)):
        for channel in range(3):
            splats.sh[i, k, channel] += sizes.sh[k] * gradient[SH + 3 * k + channel]


@compiled(merged=True)
def exp_of_step(x: float) -> float:
    """e^x for x from -1 to 1, to 1e-4; steps are about 0.02."""
    x = min(max(x, -1.0), 1.0)
    return 1 + x * (1 + x * (1 / 2 + x * (1 / 6 + x * (1 / 24 + x * (1 / 120 + x * (1 / 720 + x / 5040))))))
