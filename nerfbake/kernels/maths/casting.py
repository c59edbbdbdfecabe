"""Numbers of a file in the type that a scene holds them in, without a word: what cannot be is the scene's to tell."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt


def cast(values: npt.NDArray[Any], dtype: npt.DTypeLike) -> npt.NDArray[Any]:
    """The values as this dtype, the same array where they have it: infinite where it has no room for them.

    A NaN that signals (any file may hold one) makes the processor complain when it is widened, and NumPy warn.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        return values.astype(dtype, copy=False)
