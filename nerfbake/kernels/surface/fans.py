"""Triangles of polygons, without numba, so that commands that only read files start fast."""

from __future__ import annotations

import numpy as np

from nerfbake.kernels.arrays import Ints


def fan(starts: Ints, counts: Ints) -> Ints:
    """(t, 3) the corners of the triangles of polygons, whose corners are the numbers from `starts` on.

    The triangles of a polygon: its first corner, with each pair of consecutive other corners. counts: 3 or more.
    """
    triangles = counts - 2
    first = np.repeat(starts, triangles)
    step = np.arange(triangles.sum()) - np.repeat(np.cumsum(triangles) - triangles, triangles)
    return np.stack([first, first + step + 1, first + step + 2], axis=1)
