"""Means that a picture survives: densities by volume, coefficients by volume and opacity.

The opacity of a piece is 1 - exp(-sigma l) with ONE length l for the whole scene, the width of the tree's finest
cell. So the mean does not depend on how finely a uniform region happens to be cut, and the mean of means is the
mean of everything below: a level of detail shows the same as a bake at that resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.parallel import over_chunks

CHUNK = 1 << 11  # runs at a time: temporaries stay in the second-level cache

Floats = npt.NDArray[np.float64]


class Weighted(NamedTuple):
    """Rows of values with the mean opacity behind them, which is what they weigh in the next mean."""

    values: npt.NDArray[np.float32]  # (m, D), density last
    opacity: Floats  # (m,)


def opacity(sigma: npt.NDArray[Any], length: float) -> Floats:
    """1 - exp(-sigma length), 0 for densities below 0."""
    depth: Floats = np.maximum(sigma, 0, dtype=np.float64) * length
    return -np.expm1(-depth)


def mean_edge(edges: Floats) -> float:
    """The edge of the cube that has the volume of this box: (3,) -> their geometric mean."""
    return float(np.prod(edges) ** (1 / 3))


def mean_of_runs(
    rows_at: Callable[[npt.NDArray[np.int64]], npt.NDArray[Any]],
    weight: Floats,
    volume: Floats,
    counts: npt.NDArray[np.int64],
    data_dim: int,
) -> Weighted:
    """Means over runs of consecutive rows: the first run is counts[0] rows, the next counts[1], and so on.

    rows_at(i) gives the values (len(i), D) of some of the rows 0 .. m, density last; weight (m,) opacities; volume
    (m,) each row's share of its run's volume (what is left to 1 is empty). Sums run from a run's first row to its
    last, the same on every machine.
    """
    # Longest runs first, so that the k-th rows of all that have one are the first few of a chunk.
    order = np.argsort(-counts, kind="stable")
    starts, longest = (np.cumsum(counts) - counts)[order], int(counts.max(initial=0))
    with_at_least = np.searchsorted(-counts[order], -np.arange(longest), side="left")
    out = np.empty((len(starts), data_dim), np.float32)
    sorted_opacity = np.zeros(len(starts))
    share = (weight * volume).astype(np.float32)

    def work(begin: int, end: int) -> None:
        total = np.zeros((end - begin, data_dim), np.float32)
        for k in range(longest):
            some = min(int(with_at_least[k]), end) - begin
            if some <= 0:
                break
            rows = starts[begin : begin + some] + k
            piece = rows_at(rows).astype(np.float32, copy=False)
            piece[:, :-1] *= share[rows, None]
            piece[:, -1] *= volume[rows]
            total[:some] += piece
            sorted_opacity[begin : begin + some] += weight[rows] * volume[rows]
        divisor = sorted_opacity[begin:end].astype(np.float32)
        total[:, :-1] /= np.where(divisor > 0, divisor, 1)[:, None]
        out[order[begin:end]] = total

    over_chunks(work, len(starts), CHUNK)
    out_opacity = np.empty(len(starts))
    out_opacity[order] = sorted_opacity
    return Weighted(out, out_opacity)
