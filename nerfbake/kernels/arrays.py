"""Type aliases for NumPy arrays. The docstrings of the functions give shapes and units."""

from __future__ import annotations

from typing import Any

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
