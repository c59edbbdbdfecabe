"""Type aliases for NumPy arrays, and as_input() for the arguments of kernels.

The docstrings of the functions give shapes and units.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

Bits = npt.NDArray[np.bool_]
Coords = npt.NDArray[np.int32]  # (..., 3) voxel coordinates
Faces = npt.NDArray[Any]  # (t, 3) vertex numbers of triangles, integers of any width
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

    Numba compiles a kernel again if an argument has another layout, or is read-only, as mapped files are.
    """
    view = np.ascontiguousarray(array).view()
    view.flags.writeable = False
    return view
