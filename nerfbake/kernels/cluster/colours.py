"""Morton codes of 8-bit colours: numbers whose order keeps neighbouring colours together.

A code is the colour's 24 bits interleaved, the highest first: r7 g7 b7 r6 g6 b6 ... r0 g0 b0, so that
code >> 3 (8 - b) numbers the cells of a grid of 2^b cells along each axis, and sorting by code sorts by such cells.
Features of F channels, up to 8, have codes of 8 F bits in the same way.
"""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import numpy.typing as npt

CODES = 1 << 24  # of colours of three channels
MAX_CHANNELS = 8

Codes = npt.NDArray[np.uint32 | np.uint64]


def codes_of(colours: npt.NDArray[np.uint8]) -> Codes:
    """(..., F) uint8 -> (...) codes: uint32 for up to four channels, else uint64."""
    F = colours.shape[-1]
    spread = _spread(F)
    codes: Codes = spread[colours[..., 0]] << spread.dtype.type(F - 1)
    for channel in range(1, F):
        codes |= spread[colours[..., channel]] << spread.dtype.type(F - 1 - channel)
    return codes


@cache
def _spread(F: int) -> npt.NDArray[Any]:
    """(256,) each byte with its bits F apart."""
    code = np.uint32 if F <= 4 else np.uint64
    bits = np.arange(256)[:, None] >> np.arange(8) & 1
    return np.asarray((bits.astype(code) << (F * np.arange(8)).astype(code)).sum(axis=1), code)


def colours_of(codes: Codes, F: int = 3) -> npt.NDArray[np.uint8]:
    """(...) codes -> (..., F) uint8: the inverse of codes_of()."""
    if F != 3:
        colours, one = np.zeros((*codes.shape, F), np.uint8), codes.dtype.type(1)
        for place in range(8 * F):
            bit = codes >> codes.dtype.type(place) & one
            colours[..., F - 1 - place % F] |= bit.astype(np.uint8) << np.uint8(place // F)
        return colours
    bits = codes[..., None] >> np.array([2, 1, 0], np.uint32) & 0x249249
    for shift, keep in ((2, 0x0C30C3), (4, 0x00F00F), (8, 0x0000FF)):  # every third bit -> pairs -> fours -> a byte
        bits = (bits | bits >> shift) & keep
    return bits.astype(np.uint8)


def runs(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """(runs + 1,) where each run of equal values of a sorted array starts, then the length of the array."""
    return np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1], [True]]))
