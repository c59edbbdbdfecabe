"""Convert values to float16 with a range check, so that large values are an error and do not become infinite."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem

LARGEST = 65504.0  # largest finite float16


def cast_values(values: npt.NDArray[Any], dtype: np.dtype[Any], *, what: str, asked: str) -> npt.NDArray[Any]:
    """Return the values as dtype, without a copy if they have it already.

    Raises InvalidScene if a value is too large for float16. what, asked: for the message, the scene that contains the
    value, and the option or type that requires float16.
    """
    if dtype == np.float16 and values.dtype != np.float16 and values.size:
        largest = float(np.abs(values).max())
        if largest > LARGEST:
            raise InvalidScene(Problem(what, f"holds {largest:g}", f"up to {LARGEST:g} for {asked}"))
    return values.astype(dtype, copy=False)
