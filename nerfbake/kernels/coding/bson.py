"""Numbers in a BSON array whose elements have different types: int32 (16), int64 (18) and double (1).

    element   type | index as text 00 | value, little-endian

The size of an element depends on its type, so elements are found one after the other.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.jit import compiled

_DOUBLE, _INT32, _INT64 = 1, 16, 18


@compiled()
def scan_numbers(body: npt.NDArray[np.uint8]) -> tuple[int, int]:
    """Count the elements of an array, and the doubles among them. (-1, 0) if it holds anything but whole numbers."""
    at, count, doubles = 0, 0, 0
    while at < len(body):
        kind = body[at]
        if kind != _DOUBLE and kind != _INT32 and kind != _INT64:
            return -1, 0
        at = _value_at(body, at) + (4 if kind == _INT32 else 8)
        if at > len(body):
            return -1, 0
        count += 1
        doubles += kind == _DOUBLE
    return count, doubles


@compiled()
def fill_numbers(body: npt.NDArray[np.uint8], doubles: bool, whole: Ints, real: Floats) -> None:
    """Write the numbers of an array that scan_numbers() has counted. `real` is a view of the memory of `whole`.

    doubles: write all of them as float64 to `real`, else as int64 to `whole`.
    """
    at = 0
    for i in range(len(whole)):
        kind = body[at]
        at = _value_at(body, at)
        size = 4 if kind == _INT32 else 8
        bits = np.uint64(0)
        for k in range(size):
            bits |= np.uint64(body[at + k]) << np.uint64(8 * k)
        at += size
        number = np.int64(bits)
        if kind == _INT32:
            number = np.int64(np.int32(bits))
        if doubles and kind != _DOUBLE:
            real[i] = number
        else:
            whole[i] = number


@compiled()
def _value_at(body: npt.NDArray[np.uint8], at: int) -> int:
    """The place after the zero that ends an element's name; after the end if there is none."""
    at += 1
    while at < len(body) and body[at] != 0:
        at += 1
    return at + 1
