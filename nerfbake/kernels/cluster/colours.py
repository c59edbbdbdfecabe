"""Morton codes of 8-bit colours: numbers whose order keeps neighbouring colours together.

A code is the colour's 24 bits interleaved, the highest first: r7 g7 b7 r6 g6 b6 ... r0 g0 b0, so that
code >> 3 (8 - b) numbers the cells of a grid of 2^b cells along each axis, and sorting by code sorts by such cells.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.octree.lookup import dilate

CODES = 1 << 24
_SPREAD = dilate(np.arange(256)).astype(np.uint32)


def codes_of(colours: npt.NDArray[np.uint8]) -> npt.NDArray[np.uint32]:
    """(..., 3) uint8 -> (...) codes."""
    r, g, b = (_SPREAD[colours[..., channel]] for channel in range(3))
    return (r << 2 | g << 1 | b).astype(np.uint32, copy=False)


def colours_of(codes: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint8]:
    """(...) codes -> (..., 3) uint8: the inverse of codes_of()."""
    bits = codes[..., None] >> np.array([2, 1, 0], np.uint32) & 0x249249
    for shift, keep in ((2, 0x0C30C3), (4, 0x00F00F), (8, 0x0000FF)):  # every third bit -> pairs -> fours -> a byte
        bits = (bits | bits >> shift) & keep
    return bits.astype(np.uint8)


def runs(values: npt.NDArray[Any]) -> npt.NDArray[np.int64]:
    """(runs + 1,) where each run of equal values of a sorted array starts, then the length of the array."""
    return np.flatnonzero(np.concatenate([[True], values[1:] != values[:-1], [True]]))
