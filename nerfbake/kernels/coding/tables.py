"""Whole-number tables for probabilities: the logistic function, its inverse, how fast a model learns, and buckets.

    squash(x) = 65536 / (1 + e^(-x / 256))      x from -2047 to 2047: a probability in 1/65536
    stretch(p)                                  its inverse, of a probability in 1/4096

Both come from anchors that are part of the format (schemas/svoq.md), so that every reader has the same tables: nothing
here is computed with floats.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Table = npt.NDArray[np.int32]

# squash() at -2048, -1920, ..., 0; above 0 it is 65536 less that below.
ANCHORS = (22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768)
LIMIT = 250  # outcomes after which a model learns no slower

# How many of these a number reaches is its bucket. About a factor of 1.5 apart.
_SIZES = (1, 2, 3, 5, 7, 10, 15, 23, 36, 60, 120)
_MATCHES = (1, 2, 3, 5, 8, 14, 24, 44, 90)


def _squash() -> Table:
    """(4096,) of x + 2048; the first, which no x has, is like the second."""
    anchors = np.array([*ANCHORS, *(65536 - value for value in ANCHORS[-2::-1])], np.int32)
    x = np.arange(4096)
    x[0] = 1
    low, part = anchors[x >> 7], x & 127
    found: Table = (low * (128 - part) + anchors[(x >> 7) + 1] * part + 64 >> 7).astype(np.int32)
    return found


def _stretch(squash: Table) -> Table:
    """(4096,) of each probability p / 4096 the smallest x whose squash(x) is at least 16 p + 8."""
    x = np.searchsorted(squash[1:], 16 * np.arange(4096) + 8) - 2047
    found: Table = np.minimum(x, 2047).astype(np.int32)
    return found


def _buckets(steps: tuple[int, ...]) -> Table:
    """(steps[-1] + 1,) the bucket of each number; those above have that of the last."""
    return np.searchsorted(np.array(steps), np.arange(steps[-1] + 1), side="right").astype(np.int32)


SQUASH = _squash().astype(np.uint16)  # 8 KB each, so that both stay in the first-level cache
STRETCH = _stretch(_squash()).astype(np.int16)
RATES = (131072 // (2 * np.arange(LIMIT + 1) + 3)).astype(np.int32)  # 1 / (n + 1.5) in 1/65536
SIZES, MATCHES = _buckets(_SIZES), _buckets(_MATCHES)
SIZE_BUCKETS, MATCH_BUCKETS = len(_SIZES) + 1, len(_MATCHES) + 1
