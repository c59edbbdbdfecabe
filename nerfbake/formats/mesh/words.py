"""Words and lines of a text, as columns."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Ints


def words_of(text: bytes) -> tuple[Ints, Ints]:
    """Return the start of each word, and the line that contains it."""
    bytes_ = np.frombuffer(text, np.uint8)
    solid = bytes_ > ord(" ")
    starts = np.flatnonzero(solid & ~np.concatenate([[False], solid[:-1]])) if len(solid) else np.empty(0, np.int64)
    return starts, np.searchsorted(np.flatnonzero(bytes_ == ord("\n")), starts)
