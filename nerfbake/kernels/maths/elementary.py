"""Elementary functions with the same last bit on every CPU, column extremes, casts and evenly spread directions.

NumPy and the C library select code for the CPU that they run on (AVX-512, FMA or neither), and the last bits of their
results differ. exp, log, sine, cosine, tangent and arctangent here use only sums, products, quotients, square roots and
table entries, which IEEE 754 defines to the bit. They take arrays of any shape and return float64, within a few units
in the last place of the true value.
"""

from __future__ import annotations

from math import isqrt
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats

_STEPS = 32  # table entries from 1 to 2
# 2^(j / 32) by five integer square roots of 2^(j + 32 * 64), exact to the last bit.
_ROOTS = np.array([isqrt(isqrt(isqrt(isqrt(isqrt(1 << j + 32 * 64))))) / (1 << 64) for j in range(_STEPS)])
_LOWEST = 1080
_POWERS = np.ldexp(1.0, np.arange(-_LOWEST, 1024))  # the first entries underflow to 0
_PER_STEP = 46.16624130844683  # 32 / ln 2
# ln 2 / 32 in two parts: the first has 32 bits, so that its products with integers are exact.
_STEP_HIGH, _STEP_LOW = 0.021660849393811077, -1.312785960212839e-12
_MOST, _LEAST = 709.0, -746.0
_LN2_HIGH, _LN2_LOW = 0.6931471806019545, -4.2009150726810846e-11
# pi / 2 in three parts of 33 bits.
_QUARTER = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)


def exp_parts(x: Any) -> Any:
    """Return (s, q) such that e^x = s + s q and e^x - 1 = (s - 1) + s q. x is clamped to -746 .. 709.

    x is an array or, in compiled code, a number. s is a power of 2^(1/32), and q is below 1/90.
    """
    x = np.minimum(np.maximum(x, _LEAST), _MOST)
    whole = np.fmax(np.rint(x * _PER_STEP), _LEAST * _PER_STEP)  # a valid table index even for NaN, which q propagates
    r = (x - whole * _STEP_HIGH) - whole * _STEP_LOW
    q = r * (1 + r * (1 / 2 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720))))))
    k = np.int32(whole)  # not 64 bits: few CPUs convert several floats to int64 at once
    return _ROOTS[k & (_STEPS - 1)] * _POWERS[(k >> 5) + _LOWEST], q


def exp(x: npt.ArrayLike) -> Floats:
    """e^x."""
    s, q = exp_parts(np.asarray(x, np.float64))
    return np.asarray(s + s * q)


def expm1(x: npt.ArrayLike) -> Floats:
    """e^x - 1, accurate to the last digits where x is near 0."""
    s, q = exp_parts(np.asarray(x, np.float64))
    return np.asarray((s - 1) + s * q)


def sigmoid(x: npt.ArrayLike) -> Floats:
    """1 / (1 + e^-x)."""
    return np.asarray(1 / (1 + exp(-np.asarray(x, np.float64))))


def log(x: npt.ArrayLike) -> Floats:
    """The natural logarithm of finite numbers above 0."""
    m, e = np.frexp(np.asarray(x, np.float64))
    low = m < 0.7071067811865476
    m, k = np.where(low, 2 * m, m), (e - low).astype(np.float64)
    # ln m = 2 artanh(s), s at most 0.172.
    s = (m - 1) / (m + 1)
    z = s * s
    series = 1 / 23
    for n in range(21, 1, -2):
        series = series * z + 1 / n
    return np.asarray(k * _LN2_HIGH + (2 * s + (2 * s * z * series + k * _LN2_LOW)))


def power(x: npt.ArrayLike, exponent: float) -> Floats:
    """x^exponent, for finite numbers above 0."""
    return exp(exponent * log(x))


def sine_cosine(x: npt.ArrayLike) -> tuple[Floats, Floats]:
    """sin x and cos x, for angles below a million radians."""
    x = np.asarray(x, np.float64)
    quarters = np.rint(x * (2 / np.pi))
    r = x
    for part in _QUARTER:
        r = r - quarters * part
    z = r * r
    sine, cosine = np.full_like(r, 1.0), np.full_like(r, 1.0)
    for n in range(17, 1, -2):
        sine = 1 - sine * z / (n * (n - 1))
    for n in range(16, 0, -2):
        cosine = 1 - cosine * z / (n * (n - 1))
    sine = sine * r
    k = quarters.astype(np.int64) & 3
    odd = (k & 1).astype(bool)
    turned, other = np.where(odd, cosine, sine), np.where(odd, sine, cosine)
    return np.where(k >= 2, -turned, turned), np.where((k == 1) | (k == 2), -other, other)


def tangent(x: npt.ArrayLike) -> Floats:
    """tan x, for angles below a million radians."""
    sine, cosine = sine_cosine(x)
    return np.asarray(sine / cosine)


def arctan(x: npt.ArrayLike) -> Floats:
    """The angle from -pi/2 to pi/2 with this tangent."""
    x = np.asarray(x, np.float64)
    t = np.abs(x)
    steep = t > 1
    t = np.where(steep, 1 / np.maximum(t, 1), t)
    for _ in range(2):  # each round halves the angle: at most 11 degrees remain
        t = t / (1 + np.sqrt(1 + t * t))
    z = t * t
    series = np.full_like(t, 1 / 25)
    for n in range(23, 0, -2):
        series = 1 / n - series * z
    angle = 4 * t * series
    return np.asarray(np.copysign(np.where(steep, np.pi / 2 - angle, angle), x))


_CHUNK = 1 << 18  # values at a time: the selected values stay in the cache, and memory stays bounded


class Extremes(NamedTuple):
    """Minimum and maximum of each of C columns; inf and -inf for a column without finite values."""

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    non_finite: int  # number of values, in all columns together

    def range(self, columns: slice | npt.NDArray[np.intp] = slice(None)) -> list[float] | None:
        """[minimum, maximum] over the selected columns; None if they contain no finite value."""
        low, high = self.low[columns].min(initial=np.inf), self.high[columns].max(initial=-np.inf)
        return [float(low), float(high)] if low <= high else None


def extremes(values: npt.NDArray[Any], which: npt.NDArray[np.bool_] | None = None) -> Extremes:
    """Return the extremes of (m, C) floats: of the rows that `which` (m,) selects, or of all rows."""
    m, C = values.shape
    low, high, non_finite = np.full(C, np.inf), np.full(C, -np.inf), 0
    step = max(1, _CHUNK // max(C, 1))
    for start in range(0, m, step):
        part = values[start : start + step]
        if which is not None:
            part = part[which[start : start + step]]
        finite = np.isfinite(part)
        np.minimum(low, part.min(axis=0, where=finite, initial=np.inf), out=low)
        np.maximum(high, part.max(axis=0, where=finite, initial=-np.inf), out=high)
        non_finite += finite.size - int(np.count_nonzero(finite))
    return Extremes(low, high, non_finite)


def cast(values: npt.NDArray[Any], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """Return the values as this dtype, or the same array if they already have it. Overflow gives infinity.

    No warning is printed: the checks of the scene report such values. A signalling NaN, which any file may contain,
    raises a CPU exception when it is widened, and NumPy would warn.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(dtype, copy=False)


def fibonacci(N: int) -> npt.NDArray[np.float64]:
    """(N, 3) unit directions on a golden-angle spiral about z. Source: docs/conventions.md, "Direction sets"."""
    i = np.arange(N) + 0.5
    z, turn = 1 - 2 * i / N, np.pi * (1 + np.sqrt(5)) * i
    (sine, cosine), wide = sine_cosine(turn), np.sqrt(1 - z * z)
    return np.stack([cosine * wide, sine * wide, z], axis=1)
