"""Rows of polygons with different numbers of corners."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Ints
from nerfbake.kernels.jit import compiled

_SHORT, _NEGATIVE = -1, -2  # instead of the number of units read


def find_lists(body: npt.NDArray[np.uint8], rows: int, steps: Ints, wanted: int, *, swapped: bool) -> tuple[Ints, Ints]:
    """Return (rows,) the offset of a list in each row, and its length, of rows whose lists have any lengths.

    body     (b,) the bytes of the rows
    steps    (properties, 3) bytes of a number or of a list's entries, bytes of a list's length (0 for a number), and 1
             if that length is signed
    wanted   the index of the list
    swapped  lengths are big endian

    Raises ValueError if the rows do not end within the body, or if a length is negative.
    """
    starts, counts = np.zeros(rows, np.int64), np.zeros(rows, np.int64)
    if _walk(body, steps, wanted, swapped, starts, counts) < 0:
        raise ValueError("the lists do not fit")
    return starts, counts


@compiled()
def _walk(
    body: npt.NDArray[np.uint8],
    steps: Ints,
    wanted: int,
    swapped: bool,
    starts: Ints,
    counts: Ints,
) -> int:
    at, end = 0, len(body)
    for row in range(len(starts)):
        for k in range(len(steps)):
            width, size = steps[k, 0], steps[k, 1]
            count = np.int64(1)
            if size:
                if at + size > end:
                    return _SHORT
                count = np.int64(0)
                for byte in range(size):
                    count |= np.int64(body[at + (size - 1 - byte if swapped else byte)]) << (8 * byte)
                if steps[k, 2] and count >> (8 * size - 1):
                    return _NEGATIVE
                at += size
            if k == wanted:
                starts[row], counts[row] = at, count
            if count > (end - at) // width:
                return _SHORT
            at += count * width
    return at
