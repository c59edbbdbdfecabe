"""Type aliases for NumPy arrays, whose shapes and units the docstrings of the functions give, and as_input()."""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Bits = npt.NDArray[np.bool_]
Coords = npt.NDArray[np.int32]  # (..., 3) voxel coordinates
Floats = npt.NDArray[np.float64]
Indices = npt.NDArray[np.signedinteger[Any]]  # integers of any width
Ints = npt.NDArray[np.int64]
Points = npt.NDArray[np.float64]  # (..., 3)
Singles = npt.NDArray[np.float32]
Words = npt.NDArray[np.uint64]
f32 = np.float32

Number = TypeVar("Number", bound=np.generic)


def as_input(array: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return a contiguous read-only view, or copy, of an array that a kernel only reads.

    A kernel is compiled again for an argument of another layout, and for a read-only one, such as a mapped file.
    """
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view
