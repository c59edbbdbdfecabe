"""Codebooks: 256 numbers for many, and a palette of rows for many rows.

Sums are made in the order of the sorted numbers, or of the rows, so that every CPU finds the same.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from nerfbake.kernels.arrays import Floats, Ints, Singles

_ROUNDS = 40  # of Lloyd's algorithm: the error changes by less than 0.1 % after them


def fit_codebook(values: npt.NDArray[np.floating], size: int = 256) -> Floats:
    """(size,) ascending numbers, so that the mean square to the nearest of them is small (Lloyd, 1957).

    It starts with numbers of which each represents about the same third root of the density, which is best for many.
    """
    ordered = np.sort(np.asarray(values, np.float64).reshape(-1))
    distinct = ordered[np.concatenate([[True], ordered[1:] != ordered[:-1]])]
    if len(distinct) <= size:
        return np.concatenate([distinct, np.full(size - len(distinct), distinct[-1])])
    # Between quantiles of the numbers and equal steps: quantiles alone leave the ends of the range out.
    shares = (np.arange(size) + 0.5) / size
    quantiles = ordered[(shares * len(ordered)).astype(np.int64)]
    even = ordered[0] + (ordered[-1] - ordered[0]) * shares
    book = np.sort(0.5 * (quantiles + even))
    sums = np.concatenate([[0.0], np.cumsum(ordered)])
    for _ in range(_ROUNDS):
        ends = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        edges = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(edges)
        means = np.diff(sums[edges]) / np.maximum(counts, 1)
        book = np.sort(np.where(counts > 0, means, book))
    return book


def nearest_codes(values: npt.NDArray[np.floating], book: Floats) -> npt.NDArray[np.uint8]:
    """The nearest entry of a codebook of at most 256 numbers, in the shape of the values."""
    codes = np.searchsorted((book[1:] + book[:-1]) / 2, np.asarray(values, np.float64))
    return np.asarray(codes, np.uint8)


def fit_palette(rows: Singles, size: int) -> tuple[Singles, Ints]:
    """Return at most `size` rows (K, p), and for each row (n,) the one that stands for it.

    Cells are split at the mean of their widest dimension, those with the largest error first, until there are as many
    as may be (tree-structured vector quantisation). All rows are kept if they are few enough.
    """
    n = len(rows)
    if n <= size:
        return rows.copy(), np.arange(n)
    order = np.arange(n)
    start = np.array([0, n])
    while (cells := len(start) - 1) < size:
        held = rows[order].astype(np.float64)
        counts = np.diff(start)
        sums = np.add.reduceat(held, start[:-1], axis=0)
        means = sums / counts[:, None]
        held -= np.repeat(means, counts, axis=0)
        spread = np.add.reduceat(held * held, start[:-1], axis=0)
        error = spread.sum(axis=1)
        # At most a third of the cells at a time, the worst first, so that the others can become worse than theirs.
        worst = np.argsort(-error, kind="stable")[: min(size - cells, max(cells // 3, 1))]
        worst = np.sort(worst[error[worst] > 0])
        if not len(worst):
            break
        chosen = np.zeros(cells, bool)
        chosen[worst] = True
        widest = np.repeat(spread.argmax(axis=1), counts)
        above = (held[np.arange(n), widest] > 0) & np.repeat(chosen, counts)
        cell = np.repeat(np.arange(cells), counts)
        order = order[np.argsort(2 * cell + above, kind="stable")]
        below = counts - np.add.reduceat(above.astype(np.int64), start[:-1])
        start = np.sort(np.concatenate([start, (start[:-1] + below)[chosen]]))
    counts = np.diff(start)
    label = np.empty(n, np.int64)
    label[order] = np.repeat(np.arange(len(counts)), counts)
    means = np.add.reduceat(rows[order].astype(np.float64), start[:-1], axis=0) / counts[:, None]
    return means.astype(np.float32), label
