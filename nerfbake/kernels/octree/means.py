"""Means that a picture survives: densities by volume, coefficients by volume and opacity.

The opacity of a piece is 1 - exp(-sigma l) with ONE length l for the whole scene, the width of the tree's finest
cell. So the mean does not depend on how finely a uniform region happens to be cut, and the mean of means is the
mean of everything below: a level of detail shows the same as a bake at that resolution.
"""

from __future__ import annotations

from collections.abc import Callable
from math import cbrt
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats
from nerfbake.kernels.maths.elementary import expm1
from nerfbake.kernels.parallel import over_chunks

_CHUNK = 1 << 12  # rows at a time: temporaries stay in the second-level cache


def opacity(sigma: npt.NDArray[Any], length: float) -> Floats:
    """1 - exp(-sigma length), 0 for densities below 0."""
    flat = np.asarray(sigma).reshape(-1)
    found = np.empty(len(flat))

    def work(begin: int, end: int) -> None:
        depth = np.maximum(flat[begin:end], 0, dtype=np.float64) * length
        found[begin:end] = -expm1(-depth)

    over_chunks(work, len(flat), 1 << 14)
    return found.reshape(np.shape(sigma))


def mean_edge(edges: Floats) -> float:
    """The edge of the cube that has the volume of this box: (3,) -> their geometric mean."""
    return cbrt(float(np.prod(edges)))


def mean_of_runs(
    rows_at: Callable[[int, int], npt.NDArray[Any]],
    weight: Floats,
    volume: Floats,
    counts: npt.NDArray[np.int64],
    out: npt.NDArray[Any],
) -> Floats:
    """Means over runs of consecutive rows: the first run is counts[0] rows, the next counts[1], and so on.

    They are written to out (p, D); what comes back is the mean opacity behind each, which is what it weighs in the
    next mean. rows_at(begin, end) gives the values (end - begin, D) of some of the rows 0 .. m, density last;
    weight (m,) opacities; volume (m,) each row's share of its run's volume (what is left to 1 is empty). Sums run
    from a run's first row to its last, the same on every machine.
    """
    ends = np.cumsum(counts)
    out_opacity = np.zeros(len(counts))
    # Blocks of whole runs, each about as many rows.
    edges = np.flatnonzero(np.diff(ends // _CHUNK, prepend=-1, append=-1))

    def work(begin: int, end: int) -> None:
        for run, stop in zip(edges[begin:end], edges[begin + 1 : end + 1], strict=True):
            some = slice(run, stop)
            first, last = int(ends[run] - counts[run]), int(ends[stop - 1])
            share = weight[first:last] * volume[first:last]
            rows = rows_at(first, last).astype(np.float32, copy=False)
            pieces = rows * share.astype(np.float32)[:, None]
            pieces[:, -1] = rows[:, -1] * volume[first:last]
            total, out_opacity[some] = _sums(pieces, share, counts[some])
            divisor = out_opacity[some].astype(np.float32)
            total[:, :-1] /= np.where(divisor > 0, divisor, 1)[:, None]
            out[some] = total

    over_chunks(work, len(edges) - 1, 1)
    return out_opacity


def _sums(
    pieces: npt.NDArray[np.float32], share: Floats, counts: npt.NDArray[np.int64]
) -> tuple[npt.NDArray[np.float32], Floats]:
    """Of each run, row after row."""
    # Longest runs first, so that the k-th rows of all that have one are the first few.
    order = np.argsort(-counts, kind="stable")
    starts = (np.cumsum(counts) - counts)[order]
    with_at_least = np.searchsorted(-counts[order], -np.arange(int(counts.max())), side="left")
    total, opacities = np.zeros((len(counts), pieces.shape[1]), np.float32), np.zeros(len(counts))
    for k, some in enumerate(with_at_least):
        rows = starts[:some] + k
        total[:some] += pieces.take(rows, axis=0)
        opacities[:some] += share[rows]
    back = np.empty(len(order), np.int64)
    back[order] = np.arange(len(order))
    return total.take(back, axis=0), opacities[back]
