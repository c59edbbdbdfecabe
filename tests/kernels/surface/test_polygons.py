"""Lists of different lengths in rows of bytes, and the triangles of polygons."""

from __future__ import annotations

import numpy as np
import pytest

from nerfbake.kernels.surface.fans import fan
from nerfbake.kernels.surface.polygons import find_lists

# A row: a byte, a list of u16 with a signed length of two bytes, a list of bytes.
STEPS = np.array([[1, 0, 0], [2, 2, 1], [1, 1, 0]], np.int64)


def row(first: list[int], second: list[int], order: str) -> bytes:
    return b"\x07" + np.array([len(first), *first], order + "u2").tobytes() + bytes([len(second), *second])


@pytest.mark.parametrize("order", ["<", ">"])
def test_lists_are_found_by_hand(order: str) -> None:
    body = np.frombuffer(row([5, 6, 7], [1], order) + row([], [2, 3], order) + b"rest", np.uint8)
    starts, counts = find_lists(body, 2, STEPS, 1, swapped=order == ">")
    assert (starts.tolist(), counts.tolist()) == ([3, 14], [3, 0])
    starts, counts = find_lists(body, 2, STEPS, 2, swapped=order == ">")
    assert (starts.tolist(), counts.tolist()) == ([10, 15], [1, 2])


@pytest.mark.parametrize("body", [b"", b"\x07\x01", b"\x07\xff\xff", b"\x07\xff\x7f" + bytes(90), b"\x07\x01\x00\x05"])
def test_lists_that_do_not_fit_are_refused(body: bytes) -> None:
    with pytest.raises(ValueError, match="do not fit"):
        find_lists(np.frombuffer(body, np.uint8), 1, STEPS, 1, swapped=False)


def test_polygons_become_fans() -> None:
    corners = fan(np.array([0, 3, 8]), np.array([3, 5, 4]))
    assert corners.tolist() == [[0, 1, 2], [3, 4, 5], [3, 5, 6], [3, 6, 7], [8, 9, 10], [8, 10, 11]]
