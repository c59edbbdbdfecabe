"""Convert values to float16 with a range check, so that large values are an error and do not become infinite."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import InvalidScene, Problem
from nerfbake.kernels.parallel import over_chunks

_CHUNK = 1 << 18  # values that a core converts at a time

LARGEST = 65504.0  # largest finite float16


def cast_values(values: npt.NDArray[Any], dtype: np.dtype[Any], *, what: str, asked: str) -> npt.NDArray[Any]:
    """Return the values as dtype, without a copy if they have it already.

    Raises InvalidScene if a value is too large for float16. what, asked: for the message, the scene that contains the
    value, and the option or type that requires float16.
    """
    if values.dtype == dtype or not values.size:
        return values.astype(dtype, copy=False)
    require_range(values, dtype, what=what, asked=asked)
    cast = np.empty(values.shape, dtype)

    def convert(begin: int, end: int) -> None:
        cast[begin:end] = values[begin:end]

    over_chunks(convert, len(values), _rows(values))
    return cast


def require_range(values: npt.NDArray[Any], dtype: np.dtype[Any], *, what: str, asked: str) -> None:
    """Raise InvalidScene if dtype is float16 and a value is too large for it. what, asked: as in cast_values()."""
    if dtype != np.float16 or not values.size:
        return
    rows = _rows(values)
    largest = np.zeros(-(-len(values) // rows))

    def look(begin: int, end: int) -> None:
        largest[begin // rows] = np.abs(values[begin:end]).max()

    over_chunks(look, len(values), rows)
    if len(large := largest[largest > LARGEST]):  # NaN can be cast
        raise InvalidScene(Problem(what, f"holds {large.max():g}", f"up to {LARGEST:g} for {asked}"))


def _rows(values: npt.NDArray[Any]) -> int:
    """Return the number of rows that a core converts at a time."""
    return max(1, _CHUNK * len(values) // values.size)
