"""Which pictures show the same things, and which of their features are the same point. Arrays in, arrays out.

A feature has a keypoint, (6,) float32, and a descriptor, (128,) uint8 of length 512, as COLMAP writes them. The product
of two descriptors is an integer of about 512^2 at most. float32 holds it exactly, in whatever order BLAS adds. So the
results depend neither on the CPU nor on the number of threads.

Source: SIFT (Lowe, 2004), the ratio of the two smallest distances, in both directions, with the limits of COLMAP.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import numpy.typing as npt

Descriptors = npt.NDArray[np.uint8]

PARTNERS = 20  # pictures that each picture is matched with
NEIGHBOURS = 3  # next pictures in the order of names that each picture is matched with, too
OVERLAP = 10  # the same, for frames of a video; and as many at distances of powers of two
LARGEST = 512  # features of each picture that are compared to find its partners
_ONE = np.float32(512 * 512)  # the product of equal descriptors
_NEAR = np.float32(0.765) * _ONE  # the least product of a match: an angle of 0.7
_RATIO = np.float32(0.8**2)  # the largest ratio of squared distances of the nearest and the second nearest
_BLOCK = 512  # rows of products at a time, so that they stay in the cache


def all_pairs(count: int) -> list[tuple[int, int]]:
    """Every pair of pictures."""
    return [(first, second) for first in range(count) for second in range(first + 1, count)]


def pairs_in_order(count: int) -> list[tuple[int, int]]:
    """Each picture with the next ones, and with those at distances of powers of two."""
    steps = sorted({*range(1, OVERLAP + 1), *(1 << k for k in range(OVERLAP))})
    return [(first, first + step) for first in range(count) for step in steps if first + step < count]


def likely_pairs(count: int, common: Sequence[int]) -> list[tuple[int, int]]:
    """Each picture with those that have most in common with it, and with the next ones in order.

    common: the number of matches of each of all_pairs(count). Equal numbers keep the order of the pictures.
    """
    table = np.zeros((count, count), np.int64)
    table[np.triu_indices(count, 1)] = common
    table += table.T
    chosen = {(first, first + step) for step in range(1, NEIGHBOURS + 1) for first in range(count - step)}
    for first, order in enumerate(np.argsort(-table, axis=1, kind="stable")[:, :PARTNERS].tolist()):
        chosen |= {(min(first, other), max(first, other)) for other in order if table[first, other]}
    return sorted(chosen)


def largest(keypoints: Any, descriptors: Descriptors) -> Descriptors:
    """The descriptors of the features that cover the largest parts of the picture; at most LARGEST."""
    areas = keypoints[:, 2] ** 2 + keypoints[:, 4] ** 2  # columns: x, y, and a matrix of 2 x 2 that scales and rotates
    return descriptors[np.argsort(-areas, kind="stable")[:LARGEST]]


def match(first: Descriptors, second: Descriptors) -> npt.NDArray[np.uint32]:
    """(k, 2): rows of features of two pictures, each of which is clearly the nearest one to the other."""
    a, b = first.astype(np.float32), second.astype(np.float32)
    if min(len(a), len(b)) < 2:  # there is no second nearest one
        return np.empty((0, 2), np.uint32)
    there, clear = _nearest(a, b)
    rows = np.flatnonzero(clear)
    back, clear = _nearest(b[there[rows]], a)
    rows = rows[clear & (back == rows)]
    return np.stack([rows, there[rows]], axis=1).astype(np.uint32)


def _nearest(
    queries: npt.NDArray[np.float32], features: npt.NDArray[np.float32]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """For each query, the row of the nearest feature, and whether it is near, and the second nearest is far enough."""
    nearest, clear = np.empty(len(queries), np.int64), np.empty(len(queries), np.bool_)
    for begin in range(0, len(queries), _BLOCK):
        part = slice(begin, begin + _BLOCK)
        products = queries[part] @ features.T
        each = np.arange(len(products))
        best = products.argmax(axis=1)
        product = products[each, best]
        products[each, best] = -1
        # |a - b|^2 is 2 (_ONE - product). Rounded descriptors are up to 0.2 % longer than 512.
        distance, next_distance = (np.maximum(_ONE - value, 0) for value in (product, products.max(axis=1)))
        nearest[part], clear[part] = best, (product >= _NEAR) & (distance < _RATIO * next_distance)
    return nearest, clear
