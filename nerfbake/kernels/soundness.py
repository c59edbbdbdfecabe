"""Find values in arrays that are not finite or too large, and name them as a user would type them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.errors import Problem

MAX_EDGE = 16384  # pixels along an edge of a picture
_CHUNK = 1 << 18


def place(name: str, index: tuple[Any, ...]) -> str:
    """Return the name of an array element as a user would type it: child[5, 0, 1, 0]."""
    return f"{name}[{', '.join(str(int(i)) for i in index)}]"


def plural(count: int, noun: str) -> str:
    return f"{count:,} {noun}" if count == 1 else f"{count:,} {noun}s"


def count_problem(name: str, wrong: npt.NDArray[np.bool_], values: npt.NDArray[Any], allowed: str) -> list[Problem]:
    """Return no problem, or one that names the first wrong element of `values` and counts all wrong ones."""
    count = int(np.count_nonzero(wrong))
    if not count:
        return []
    index = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
    return [Problem(place(name, index), f"is {values[index]:g}", allowed, count)]


def all_finite(values: npt.NDArray[Any]) -> bool:
    """Return whether no value is NaN or infinite. Needs no mask of the size of the array."""
    if values.dtype == np.float16:
        # Infinity is 0x7C00 and NaNs are above it; the sign bit adds 0x8000. Ten times as fast as isfinite.
        bits = values.reshape(-1).view(np.uint16)
        return all(int(part.max()) < 0xFC00 and int(part.view(np.int16).max()) < 0x7C00 for part in _parts(bits))
    return all(bool(np.isfinite(part).all()) for part in _parts(values.reshape(-1)))


def all_within(values: npt.NDArray[Any], most: float) -> bool:
    """Return whether no value is NaN or exceeds `most` in magnitude. Needs no mask of the size of the array."""
    if most >= float(np.finfo(values.dtype).max):  # `most` would be cast to float16 and overflow
        return all_finite(values)
    # Both comparisons are False for NaN.
    return all(bool(-most <= part.min() and part.max() <= most) for part in _parts(values.reshape(-1)))


def _parts(flat: npt.NDArray[Any]) -> Iterator[npt.NDArray[Any]]:
    return (flat[start : start + _CHUNK] for start in range(0, len(flat), _CHUNK))
