"""exp, log, sine, cosine and arcus tangent with the same last bit on every CPU.

NumPy and the C library choose their code by the CPU that they run on (AVX-512, FMA or neither), and the last bits of
what comes out differ. These use sums, products, quotients and table entries alone, each of which IEEE 754 defines to
the bit. Arrays of any shape, float64; within a few units in the last place of the true value.
"""

from __future__ import annotations

from math import isqrt
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats

_STEPS = 32  # of a doubling, in a table
# 2^(j / 32) by five whole square roots of 2^(j + 32 * 64), which are exact to their last bit.
_ROOTS = np.array([isqrt(isqrt(isqrt(isqrt(isqrt(1 << j + 32 * 64))))) / (1 << 64) for j in range(_STEPS)])
_LOWEST = 1080
_POWERS = np.ldexp(1.0, np.arange(-_LOWEST, 1024))  # from 0 on, where a float64 ends
_PER_STEP = 46.16624130844683  # 32 / ln 2
# ln 2 / 32 in two parts: the first has 32 bits, so that its products with whole numbers are exact.
_STEP_HIGH, _STEP_LOW = 0.021660849393811077, -1.312785960212839e-12
_MOST, _LEAST = 709.0, -746.0
_LN2_HIGH, _LN2_LOW = 0.6931471806019545, -4.2009150726810846e-11
# pi / 2 in three parts of 33 bits.
_QUARTER = (1.5707963267341256, 6.077100506303966e-11, 2.0222662487959506e-21)


def exp_parts(x: Any) -> Any:
    """(s, q) such that e^x = s + s q and e^x - 1 = (s - 1) + s q, for x from -746 to 709; further out, as there.

    An array or, compiled, a number. s is a power of 2^(1/32), q below 1/90.
    """
    x = np.minimum(np.maximum(x, _LEAST), _MOST)
    whole = np.fmax(np.rint(x * _PER_STEP), _LEAST * _PER_STEP)  # a place in the table even for NaN, which q passes on
    r = (x - whole * _STEP_HIGH) - whole * _STEP_LOW
    q = r * (1 + r * (1 / 2 + r * (1 / 6 + r * (1 / 24 + r * (1 / 120 + r * (1 / 720))))))
    k = np.int32(whole)  # not 64 bits: few CPUs make those of several floats at once
    return _ROOTS[k & (_STEPS - 1)] * _POWERS[(k >> 5) + _LOWEST], q


def exp(x: npt.ArrayLike) -> Floats:
    """e^x."""
    s, q = exp_parts(np.asarray(x, np.float64))
    return np.asarray(s + s * q)


def expm1(x: npt.ArrayLike) -> Floats:
    """e^x - 1, exact in its last digits where x is near 0."""
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
    """The angle from -pi/2 to pi/2 that has this tangent."""
    x = np.asarray(x, np.float64)
    t = np.abs(x)
    steep = t > 1
    t = np.where(steep, 1 / np.maximum(t, 1), t)
    for _ in range(2):  # half the angle each time: at most 11 degrees are left
        t = t / (1 + np.sqrt(1 + t * t))
    z = t * t
    series = np.full_like(t, 1 / 25)
    for n in range(23, 0, -2):
        series = 1 / n - series * z
    angle = 4 * t * series
    return np.asarray(np.copysign(np.where(steep, np.pi / 2 - angle, angle), x))
