"""Sums, extremes and spreads over runs of consecutive rows, empty runs included."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints
from nerfbake.kernels.vdb.bitmask import exclusive_sum

_RUNS = 1 << 10  # at a time


def reduce_runs(ufunc: np.ufunc, rows: npt.NDArray[Any], counts: Ints, empty: float) -> npt.NDArray[Any]:
    """(p, ...) the ufunc over each run; `empty` where a run has no rows. The first run is counts[0] rows, and so on."""
    out = np.full((len(counts), *rows.shape[1:]), empty, rows.dtype)
    filled = counts > 0
    if filled.any():
        out[filled] = ufunc.reduceat(rows, exclusive_sum(counts)[filled], axis=0)
    return out


def rows_of_runs(counts: Ints, order: Ints) -> Ints:
    """The rows of all runs, the runs taken in another order: counts [2, 1], order [1, 0] -> [2, 0, 1]."""
    return _rows(exclusive_sum(counts)[order], counts[order])


def in_order_of(runs: npt.NDArray[Any], counts: Ints, order: Ints) -> npt.NDArray[Any]:
    """The values of all runs, the runs taken in another order; a part at a time, as their rows take more than they."""
    starts, out, done = exclusive_sum(counts), np.empty(int(counts[order].sum()), runs.dtype), 0
    for begin in range(0, len(order), _RUNS):
        some = order[begin : begin + _RUNS]
        rows = _rows(starts[some], counts[some])
        out[done : done + len(rows)] = runs[rows]
        done += len(rows)
    return out


def _rows(starts: Ints, lengths: Ints) -> Ints:
    """The rows of runs that start there and are so long, one run behind the other."""
    return np.arange(int(lengths.sum())) + np.repeat(starts - exclusive_sum(lengths), lengths)


class RunSpread(NamedTuple):
    """Of each run: how many numbers, the least, the greatest, their mean, the sum of squares around it."""

    size: Ints
    low: npt.NDArray[np.float32]
    high: npt.NDArray[np.float32]
    mean: Floats
    squares: Floats

    @property
    def deviation(self) -> Floats:
        """(p,) population standard deviations."""
        return np.sqrt(self.squares / np.maximum(self.size, 1))


def spread_of(values: npt.NDArray[np.float32], counts: Ints, *, weight: int = 1) -> RunSpread:
    """Of runs of numbers: values (m,), each of which counts `weight` times."""
    exact = values.astype(np.float64)
    mean = reduce_runs(np.add, exact, counts, 0) / np.maximum(counts, 1)
    squares = weight * reduce_runs(np.add, (exact - np.repeat(mean, counts)) ** 2, counts, 0)
    low = reduce_runs(np.minimum, values, counts, np.inf)
    return RunSpread(weight * counts, low, reduce_runs(np.maximum, values, counts, -np.inf), mean, squares)


def spread_with(one: RunSpread, other: RunSpread) -> RunSpread:
    """Of each run of the one with the same run of the other: what spread_of() would say of both."""
    arrays: zip[tuple[npt.NDArray[Any], npt.NDArray[Any]]] = zip(one, other, strict=True)
    return spread_over(RunSpread(*(np.stack(both, axis=1).reshape(-1) for both in arrays)), np.full(len(one.size), 2))


def spread_over(parts: RunSpread, counts: Ints) -> RunSpread:
    """Of runs of spreads: what spread_of() would say of all their numbers together."""
    count = reduce_runs(np.add, parts.size, counts, 0)
    mean = reduce_runs(np.add, parts.mean * parts.size, counts, 0) / np.maximum(count, 1)
    apart = parts.size * (parts.mean - np.repeat(mean, counts)) ** 2
    low = reduce_runs(np.minimum, parts.low, counts, np.inf)
    high = reduce_runs(np.maximum, parts.high, counts, -np.inf)
    return RunSpread(count, low, high, mean, reduce_runs(np.add, parts.squares + apart, counts, 0))
