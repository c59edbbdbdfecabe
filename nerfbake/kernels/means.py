"""Means that a picture survives: densities by volume, coefficients by volume and opacity.

The opacity of a piece is 1 - exp(-sigma l) with ONE length l for the whole scene, the width of the tree's finest
cell. So the mean does not depend on how finely a uniform region happens to be cut, and the mean of means is the
mean of everything below: a level of detail shows the same as a bake at that resolution.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

CHUNK = 1 << 13

Floats = npt.NDArray[np.float64]


class Weighted(NamedTuple):
    """Rows of values with the mean opacity behind them, which is what they weigh in the next mean."""

    values: npt.NDArray[np.float32]  # (m, D), density last
    opacity: Floats  # (m,)


def opacity(sigma: npt.NDArray[Any], length: float) -> Floats:
    """1 - exp(-sigma length), 0 for densities below 0."""
    depth: Floats = np.maximum(sigma, 0, dtype=np.float64) * length
    return -np.expm1(-depth)


def mean_of_runs(
    values: npt.NDArray[Any],
    weight: Floats,
    volume: Floats,
    starts: npt.NDArray[np.int64],
    counts: npt.NDArray[np.int64],
) -> Weighted:
    """Means over runs of consecutive rows: run i is rows starts[i] to starts[i] + counts[i].

    values (m, D), density last; weight (m,) opacities; volume (m,) each row's share of its run's volume (what is
    left to 1 is empty). Sums run from the first row to the last, the same on every machine.
    """
    order = np.argsort(-counts, kind="stable")
    starts, longest = starts[order], int(counts.max(initial=0))
    with_at_least = np.searchsorted(-counts[order], -np.arange(longest), side="left")
    out = np.empty((len(starts), values.shape[1]), np.float32)
    out_opacity = np.zeros(len(starts))
    share = (weight * volume).astype(np.float32)
    for begin in range(0, len(starts), CHUNK):
        end = min(begin + CHUNK, len(starts))
        total = np.zeros((end - begin, values.shape[1]), np.float32)
        for k in range(longest):
            some = min(int(with_at_least[k]), end) - begin
            if some <= 0:
                break
            rows = starts[begin : begin + some] + k
            piece = values[rows].astype(np.float32)
            piece[:, :-1] *= share[rows, None]
            piece[:, -1] *= volume[rows]
            total[:some] += piece
            out_opacity[begin : begin + some] += weight[rows] * volume[rows]
        divisor = out_opacity[begin:end].astype(np.float32)
        total[:, :-1] /= np.where(divisor > 0, divisor, 1)[:, None]
        out[order[begin:end]] = total
    back = np.empty(len(starts))
    back[order] = out_opacity
    return Weighted(out, back)
