"""Pairs of splats that one splat replaces, and the splat that replaces them.

Splats are seen along the three axes of the world. There a splat is a Gaussian of two dimensions, times its opacity, and
all integrals over products of two of them are closed forms. No result depends on the number of threads.
"""

from __future__ import annotations

from math import sqrt
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Bits, Floats, Ints, Singles
from nerfbake.kernels.compiled import compiled_exp_parts
from nerfbake.kernels.jit import borrowed, compiled, part_of
from nerfbake.kernels.maths.linear import diagonalise
from nerfbake.kernels.parallel import on_every_core
from nerfbake.kernels.splat.project import axes_of

MOST_OPACITY = 0.99  # as in pictures of splats
_COVERAGE = 0.3  # weight of an error of alpha, relative to that of a channel
_FAR = 60.0  # squared distance, in standard deviations, beyond which two Gaussians share nothing

Numbers = npt.NDArray[np.int32]
Six = tuple[float, float, float, float, float, float]


class Mixture(NamedTuple):
    """Splats while they are merged, n rows each.

    centre (n, 3)   position
    form (n, 6)     covariance: xx, xy, xz, yy, yz, zz
    opacity (n,)    at the centre
    colour (n, 3)   mean colour, 0..1
    row (n,) int64  its row in the splats that are merged
    """

    centre: Floats
    form: Floats
    opacity: Floats
    colour: Floats
    row: Ints


class Union(NamedTuple):
    """The splat that replaces two: its moments, the share of the first one in it, and the error that it makes."""

    centre: tuple[float, float, float]
    form: Six
    opacity: float
    share: float
    error: float


@on_every_core
@compiled()
def fill_forms(core: int, cores: int, scales: Singles, quats: Singles, form: Floats) -> None:
    """Write the covariances (n, 6) of splats."""
    begin, end = part_of(len(scales), core, cores)
    for i in range(begin, end):
        a0, a1, a2, b0, b1, b2, c0, c1, c2 = axes_of(quats, i)
        s, t, u = np.float64(scales[i, 0]) ** 2, np.float64(scales[i, 1]) ** 2, np.float64(scales[i, 2]) ** 2
        form[i, 0] = s * a0 * a0 + t * b0 * b0 + u * c0 * c0
        form[i, 1] = s * a0 * a1 + t * b0 * b1 + u * c0 * c1
        form[i, 2] = s * a0 * a2 + t * b0 * b2 + u * c0 * c2
        form[i, 3] = s * a1 * a1 + t * b1 * b1 + u * c1 * c1
        form[i, 4] = s * a1 * a2 + t * b1 * b2 + u * c1 * c2
        form[i, 5] = s * a2 * a2 + t * b2 * b2 + u * c2 * c2


@on_every_core
@compiled()
def find_partners(
    core: int, cores: int, splats: Mixture, blur: float, reach: int, partners: Numbers, errors: Floats
) -> None:
    """Write for each splat the one, among `reach` rows before and after it, with which it is merged with least error.

    blur: added to the variances before splats are compared. partners (n,): rows, the lowest of equal ones.
    """
    splats, partners, errors = borrowed((splats, partners, errors))
    n = len(splats.opacity)
    begin, end = part_of(n, core, cores)
    for i in range(begin, end):
        best, least = -1, np.inf
        for j in range(max(i - reach, 0), min(i + reach + 1, n)):
            if j != i:
                error = union_of(splats, min(i, j), max(i, j), blur).error
                if error < least or best < 0:
                    best, least = j, error
        partners[i], errors[i] = best, least


@compiled()
def choose_pairs(order: Ints, partners: Numbers, taken: Bits, pairs: Numbers) -> int:
    """Write pairs (most, 2) of rows, the lower one first, and return how many: each row is in one pair at most.

    order (n,): the rows by the error of merging them with their partner. taken (n,): out; the rows of pairs.
    """
    count = 0
    for i in order:
        j = partners[i]
        if count == len(pairs):
            break
        if not taken[i] and not taken[j]:
            taken[i] = taken[j] = True
            pairs[count, 0], pairs[count, 1] = min(i, j), max(i, j)
            count += 1
    return count


@compiled()
def merge_pairs(splats: Mixture, sh: Singles, pairs: Numbers, blur: float) -> None:
    """Replace the first splat of each pair by the union, also in sh (rows of Mixture.row)."""
    for k in range(len(pairs)):
        i, j = int(pairs[k, 0]), int(pairs[k, 1])
        union = union_of(splats, i, j, blur)
        share, rest = union.share, 1 - union.share
        for axis in range(3):
            splats.centre[i, axis] = union.centre[axis]
            splats.colour[i, axis] = share * splats.colour[i, axis] + rest * splats.colour[j, axis]
        for part in range(6):
            splats.form[i, part] = union.form[part]
        splats.opacity[i] = union.opacity
        to, other = splats.row[i], splats.row[j]
        for b in range(sh.shape[1]):
            for channel in range(3):
                sh[to, b, channel] = share * sh[to, b, channel] + rest * sh[other, b, channel]


@compiled(merged=True)
def union_of(splats: Mixture, i: int, j: int, blur: float) -> Union:
    """Return the splat that replaces two splats.

    Its mean and covariance are those of the mixture, weighted by light. Light is the integral of a splat's alpha, as a
    sum over the three axes; what both cover counts once. Its opacity is the one with which it has their light. The
    error is the integral of the squared difference of the pictures, in front of the union's colour; an error of alpha
    counts in addition.
    """
    o, p = splats.opacity[i], splats.opacity[j]
    c0, c1, c2, c3, c4, c5 = _blurred(splats.form, i, blur)
    e0, e1, e2, e3, e4, e5 = _blurred(splats.form, j, blur)
    dx, dy, dz = (
        splats.centre[j, 0] - splats.centre[i, 0],
        splats.centre[j, 1] - splats.centre[i, 1],
        splats.centre[j, 2] - splats.centre[i, 2],
    )
    own = _area(c3, c4, c5) + _area(c0, c2, c5) + _area(c0, c1, c3)
    other = _area(e3, e4, e5) + _area(e0, e2, e5) + _area(e0, e1, e3)
    shared = (
        _overlap(c3, c4, c5, e3, e4, e5, dy, dz)
        + _overlap(c0, c2, c5, e0, e2, e5, dx, dz)
        + _overlap(c0, c1, c3, e0, e1, e3, dx, dy)
    )
    whole = o * own + p * other
    share = o * own / whole if whole > 0 else 0.5
    rest = 1 - share
    light = whole - o * p * shared
    # The covariance of the mixture.
    f0, f1, f2 = (
        share * c0 + rest * e0 + share * rest * dx * dx,
        share * c1 + rest * e1 + share * rest * dx * dy,
        share * c2 + rest * e2 + share * rest * dx * dz,
    )
    f3, f4, f5 = (
        share * c3 + rest * e3 + share * rest * dy * dy,
        share * c4 + rest * e4 + share * rest * dy * dz,
        share * c5 + rest * e5 + share * rest * dz * dz,
    )
    area = _area(f3, f4, f5) + _area(f0, f2, f5) + _area(f0, f1, f3)
    opacity = min(light / area, MOST_OPACITY) if area > 0 else 0.0
    # The pair with its light, where the splats do not hide each other.
    per = light / whole if whole > 0 else 0.0
    o, p = per * o, per * p
    from_i = _overlap(c3, c4, c5, f3, f4, f5, rest * dy, rest * dz)
    from_i += _overlap(c0, c2, c5, f0, f2, f5, rest * dx, rest * dz)
    from_i += _overlap(c0, c1, c3, f0, f1, f3, rest * dx, rest * dy)
    from_j = _overlap(e3, e4, e5, f3, f4, f5, share * dy, share * dz)
    from_j += _overlap(e0, e2, e5, f0, f2, f5, share * dx, share * dz)
    from_j += _overlap(e0, e1, e3, f0, f1, f3, share * dx, share * dy)
    alpha = 0.5 * (o * o * own + p * p * other + opacity * opacity * area)
    alpha += 2 * (o * p * shared - opacity * (o * from_i + p * from_j))
    apart = 0.0
    for channel in range(3):
        apart += (splats.colour[i, channel] - splats.colour[j, channel]) ** 2
    x, y = o * rest, p * share
    colours = apart * (0.5 * (x * x * own + y * y * other) - 2 * x * y * shared)
    return Union(
        (
            splats.centre[i, 0] + rest * dx,
            splats.centre[i, 1] + rest * dy,
            splats.centre[i, 2] + rest * dz,
        ),
        (f0 - blur, f1, f2, f3 - blur, f4, f5 - blur),
        opacity,
        share,
        _COVERAGE * max(alpha, 0.0) + max(colours, 0.0),
    )


@compiled(merged=True)
def _blurred(form: Floats, i: int, blur: float) -> Six:
    return form[i, 0] + blur, form[i, 1], form[i, 2], form[i, 3] + blur, form[i, 4], form[i, 5] + blur


@compiled(merged=True)
def _area(xx: float, xy: float, yy: float) -> float:
    """The integral of a Gaussian, over 2 pi. That of its square is half of it."""
    return sqrt(max(xx * yy - xy * xy, 0.0))


@compiled(merged=True)
def _overlap(xx: float, xy: float, yy: float, uu: float, uv: float, vv: float, dx: float, dy: float) -> float:
    """The integral of the product of two Gaussians, over 2 pi, with their centres dx, dy apart."""
    sxx, sxy, syy = xx + uu, xy + uv, yy + vv
    det = sxx * syy - sxy * sxy
    if not det > 0:
        return 0.0
    square = (syy * dx * dx - 2 * sxy * dx * dy + sxx * dy * dy) / det
    if square > _FAR:
        return 0.0
    power, more = compiled_exp_parts(-0.5 * square)
    both = max(xx * yy - xy * xy, 0.0) * max(uu * vv - uv * uv, 0.0)
    return float(sqrt(both / det) * (power + power * more))


@compiled()
def fill_axes(form: Floats, scales: Singles, quats: Singles) -> None:
    """Write the standard deviations (n, 3) and the rotations (n, 4) of covariances (n, 6)."""
    matrix, axes = np.empty((3, 3)), np.empty((3, 3))
    for i in range(len(form)):
        matrix[0, 0], matrix[1, 1], matrix[2, 2] = form[i, 0], form[i, 3], form[i, 5]
        matrix[0, 1] = matrix[1, 0] = form[i, 1]
        matrix[0, 2] = matrix[2, 0] = form[i, 2]
        matrix[1, 2] = matrix[2, 1] = form[i, 4]
        for a in range(3):
            for b in range(3):
                axes[a, b] = 1.0 if a == b else 0.0
        diagonalise(matrix, axes)
        turn = axes[0, 0] * (axes[1, 1] * axes[2, 2] - axes[1, 2] * axes[2, 1])
        turn -= axes[0, 1] * (axes[1, 0] * axes[2, 2] - axes[1, 2] * axes[2, 0])
        turn += axes[0, 2] * (axes[1, 0] * axes[2, 1] - axes[1, 1] * axes[2, 0])
        for a in range(3):
            scales[i, a] = sqrt(max(matrix[a, a], 0.0))
            if turn < 0:  # an ellipsoid equals its mirror image
                axes[a, 2] = -axes[a, 2]
        _write_quaternion(axes, quats, i)


@compiled()
def _write_quaternion(m: Floats, quats: Singles, i: int) -> None:
    """Write the unit quaternion w, x, y, z of a rotation matrix, from the largest of its components."""
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    k = -1
    largest = trace
    for axis in range(3):
        if m[axis, axis] > largest:
            k, largest = axis, m[axis, axis]
    if k < 0:
        w, x, y, z = 1 + trace, m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    elif k == 0:
        w, x, y, z = m[2, 1] - m[1, 2], 1 + 2 * m[0, 0] - trace, m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]
    elif k == 1:
        w, x, y, z = m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], 1 + 2 * m[1, 1] - trace, m[1, 2] + m[2, 1]
    else:
        w, x, y, z = m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1 + 2 * m[2, 2] - trace
    per = 1 / sqrt(w * w + x * x + y * y + z * z)
    quats[i, 0], quats[i, 1], quats[i, 2], quats[i, 3] = w * per, x * per, y * per, z * per
