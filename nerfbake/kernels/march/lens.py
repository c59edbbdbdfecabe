"""Polynomial lens distortion and its inverse, on the plane one unit in front of the camera.

    s = x^2 + y^2                              scale = (1 + n1 s + n2 s^2 + ...) / (1 + d1 s + d2 s^2 + ...)
    x' = x scale + 2 p1 x y + p2 (s + 2 x^2) + s1 s + s2 s^2
    y' = y scale + p1 (s + 2 y^2) + 2 p2 x y + s3 s + s4 s^2   y points down, as in OpenCV

Source: Brown, "Close-range camera calibration" (1971), in the form of OpenCV's documentation of calib3d. A fisheye lens
(Kannala and Brandt, 2006) uses the same formulas in another plane: there the length of (x, y) is the angle from the
optical axis. s1 to s4 are thin prisms (Weng, Cohen and Herniou, 1992).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats

Coefficients = Sequence[float]

EXACT = 1e-12  # largest distance between a given point and the image of the point that was found
_STEPS = 20  # of Newton's method; four are usual
_ENTRIES = 4096  # of the table with start values
_CHUNK = 1 << 14  # points at a time: temporaries stay in a core's cache


Prism = tuple[float, float, float, float]
NO_PRISM = (0.0, 0.0, 0.0, 0.0)


def undistort(
    points: Floats,
    numerator: Coefficients,
    denominator: Coefficients,
    p: tuple[float, float],
    prism: Prism = NO_PRISM,
    *,
    most: float = np.inf,
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Return the points (m, 2) that the lens maps to the given ones, and (m,) bool whether each was found.

    A point is found if it maps to within EXACT of the given point, its radius is less than `most`, and it is inside the
    fold: beyond the radius where a polynomial turns back, it describes no lens. Newton's method, from a table of the
    radial part.
    """
    found, fine = np.empty_like(points), np.zeros(len(points), bool)
    with np.errstate(all="ignore"):  # points that overflow are not found
        start, end = _table(np.sqrt((points**2).sum(axis=1).max(initial=0)), numerator, denominator, most)
        for first in range(0, len(points), _CHUNK):
            some = slice(first, first + _CHUNK)
            found[some], fine[some] = _solve(points[some], numerator, denominator, p, prism, start, end)
    return found, fine


def _table(farthest: float, n: Coefficients, d: Coefficients, most: float) -> tuple[tuple[Floats, Floats], float]:
    """Distorted radii and the radii before distortion, rising up to the farthest or to the fold; and where they end."""
    reach = farthest
    while True:
        reach = min(2 * reach, most)
        r = np.linspace(0, reach, _ENTRIES)
        behind = r * _scale(r * r, n, d)[0]
        rising = np.diff(behind) > 0
        whole = bool(rising.all())
        if not whole or behind[-1] >= farthest or reach >= min(most, 64 * farthest):
            last = _ENTRIES if whole else int(np.argmin(rising)) + 1
            return (behind[:last], r[:last]), float(r[last - 1] if not whole else reach)


def _solve(
    points: Floats,
    n: Coefficients,
    d: Coefficients,
    p: tuple[float, float],
    prism: Prism,
    start: tuple[Floats, Floats],
    end: float,
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    u, v = points.T
    far = np.sqrt(u * u + v * v)
    grown = np.divide(np.interp(far, *start), far, out=np.ones_like(far), where=far > 0)
    x, y = u * grown, v * grown
    allowed = EXACT * (1 + far)
    s1, s2, s3, s4 = prism
    for step in range(_STEPS + 1):
        s = x * x + y * y
        scale, slope = _scale(s, n, d)
        a, b = _moved(x, y, s, scale, p)
        a, b = a - u, b - v
        # The derivatives of (a, b) with respect to x and y; without prisms the matrix is symmetric.
        across = 2 * slope * x * y + 2 * p[0] * x + 2 * p[1] * y
        xy, yx = across, across
        xx = scale + 2 * slope * x * x + 2 * p[0] * y + 6 * p[1] * x
        yy = scale + 2 * slope * y * y + 6 * p[0] * y + 2 * p[1] * x
        if any(prism):
            a, b = a + s * (s1 + s2 * s), b + s * (s3 + s4 * s)
            first, second = s1 + 2 * s2 * s, s3 + 2 * s4 * s
            xx, xy = xx + 2 * first * x, xy + 2 * first * y
            yx, yy = yx + 2 * second * x, yy + 2 * second * y
        area = xx * yy - xy * yx
        away = np.maximum(np.abs(a), np.abs(b))
        if step == _STEPS or not (away > 1e-3 * allowed).any():
            break
        x, y = x - (yy * a - xy * b) / area, y - (xx * b - yx * a) / area
    fine = (away <= allowed) & (area > 0) & (s <= (end * (1 + 1 / _ENTRIES)) ** 2)
    return np.stack([x, y], axis=1), fine


def _scale(s: Floats, numerator: Coefficients, denominator: Coefficients) -> tuple[Floats, Floats]:
    """The radial part, and its derivative with respect to s."""
    n, dn = _polynomial(s, numerator)
    if not any(denominator):
        return n, dn
    d, dd = _polynomial(s, denominator)
    return n / d, (dn - n / d * dd) / d


def _polynomial(s: Floats, coefficients: Coefficients) -> tuple[Floats, Floats]:
    """1 + c1 s + c2 s^2 + ..., and its derivative."""
    value, slope = np.zeros_like(s), np.zeros_like(s)
    for c in reversed((1.0, *coefficients)):
        slope = slope * s + value
        value = value * s + c
    return value, slope


def _moved(x: Floats, y: Floats, s: Floats, scale: Floats, p: tuple[float, float]) -> tuple[Floats, Floats]:
    p1, p2 = p
    xy = 2 * x * y
    return x * scale + p1 * xy + p2 * (s + 2 * x * x), y * scale + p1 * (s + 2 * y * y) + p2 * xy
