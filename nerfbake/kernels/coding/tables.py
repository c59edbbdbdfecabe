"""Integer tables for probabilities: the logistic function, its inverse, learning rates, and buckets for contexts.

    squash(x) = 65536 / (1 + e^(-x / 256))      x from -2047 to 2047: a probability in 1/65536
    stretch(p)                                  its inverse, of a probability in 1/4096

Both are interpolated from anchors that are part of the format (schemas/svoq.md), so every reader has the same tables:
nothing here is computed with floats.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Table = npt.NDArray[np.int32]


# squash() at -2048, -1920, ..., 0. For positive x, squash(x) = 65536 - squash(-x).
ANCHORS = (22, 36, 60, 98, 162, 267, 439, 720, 1179, 1921, 3108, 4971, 7812, 11955, 17625, 24743, 32768)


LIMIT = 250  # outcomes after which the learning rate of a model stays constant


# The bucket of a number is the number of these limits that it reaches. They are about a factor of 1.5 apart.
_SIZE_LIMITS = (1, 2, 3, 5, 7, 10, 15, 23, 36, 60, 120)


_MATCH_LIMITS = (1, 2, 3, 5, 8, 14, 24, 44, 90)


def _squash() -> Table:
    """(4096,) squash(x) at x + 2048; entry 0, for which there is no x, equals entry 1."""
    anchors = np.array([*ANCHORS, *(65536 - value for value in ANCHORS[-2::-1])], np.int32)
    x = np.arange(4096)
    x[0] = 1
    low, part = anchors[x >> 7], x & 127
    found: Table = (low * (128 - part) + anchors[(x >> 7) + 1] * part + 64 >> 7).astype(np.int32)
    return found


def _stretch(squash: Table) -> Table:
    """(4096,) for each probability p / 4096 the smallest x whose squash(x) is at least 16 p + 8."""
    x = np.searchsorted(squash[1:], 16 * np.arange(4096) + 8) - 2047
    found: Table = np.minimum(x, 2047).astype(np.int32)
    return found


def _buckets(steps: tuple[int, ...]) -> Table:
    """(steps[-1] + 1,) the bucket of each number; larger numbers have the bucket of the last."""
    return np.searchsorted(np.array(steps), np.arange(steps[-1] + 1), side="right").astype(np.int32)


SQUASH = _squash().astype(np.uint16)  # 8 KB each, so that both stay in the first-level cache


STRETCH = _stretch(_squash()).astype(np.int16)


RATES = (131072 // (2 * np.arange(LIMIT + 1) + 3)).astype(np.int32)  # 1 / (n + 1.5) in 1/65536


SIZES, MATCHES = _buckets(_SIZE_LIMITS), _buckets(_MATCH_LIMITS)


SIZE_BUCKETS, MATCH_BUCKETS = len(_SIZE_LIMITS) + 1, len(_MATCH_LIMITS) + 1
