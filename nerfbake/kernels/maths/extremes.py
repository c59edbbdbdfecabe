"""The least and the greatest finite value of each column of a table, a piece of the table at a time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

_CHUNK = 1 << 18  # values at a time: what is chosen of them stays in the cache, and memory bounded


class Extremes(NamedTuple):
    """Of each of C columns; of none that is finite inf and -inf."""

    low: npt.NDArray[np.float64]
    high: npt.NDArray[np.float64]
    non_finite: int  # of all columns together

    def range(self, columns: slice | npt.NDArray[np.intp] = slice(None)) -> list[float] | None:
        """[least, greatest] of some columns, None where nothing in them is finite."""
        low, high = self.low[columns].min(initial=np.inf), self.high[columns].max(initial=-np.inf)
        return [float(low), float(high)] if low <= high else None


def extremes(values: npt.NDArray[Any], which: npt.NDArray[np.bool_] | None = None) -> Extremes:
    """Of (m, C) floats the rows that `which` (m,) chooses, or all."""
    m, C = values.shape
    low, high, non_finite = np.full(C, np.inf), np.full(C, -np.inf), 0
    step = max(1, _CHUNK // max(C, 1))
    for start in range(0, m, step):
        part = values[start : start + step]
        if which is not None:
            part = part[which[start : start + step]]
        finite = np.isfinite(part)
        np.minimum(low, part.min(axis=0, where=finite, initial=np.inf), out=low)
        np.maximum(high, part.max(axis=0, where=finite, initial=-np.inf), out=high)
        non_finite += finite.size - int(np.count_nonzero(finite))
    return Extremes(low, high, non_finite)
