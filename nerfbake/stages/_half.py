"""Values in the type that they are asked for in; what float16 cannot hold is refused, not made infinite."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem

LARGEST = 65504.0  # that float16 can hold


def rounded(values: npt.NDArray[Any], dtype: np.dtype[Any], *, what: str, asked: str) -> npt.NDArray[Any]:
    """values as dtype, themselves where they are so already. Raises InvalidScene, naming `what` holds too much and
    who `asked` for float16."""
    if dtype == np.float16 and values.dtype != np.float16 and values.size:
        largest = float(np.abs(values).max())
        if largest > LARGEST:
            raise InvalidScene(Problem(what, f"holds {largest:g}", f"up to {LARGEST:g} for {asked}"))
    return values.astype(dtype, copy=False)
