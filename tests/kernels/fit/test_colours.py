"""Colours of a brick's cells: the basis in the directions to their centres."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from nerfbake.kernels.fit.colours import evaluate_basis, new_colour_buffer
from nerfbake.kernels.march.sh import sh_basis


@pytest.mark.parametrize("B", [1, 4, 9, 16, 25])
def test_the_basis_of_cells_is_the_one_of_all_commands(B: int) -> None:
    random, room = np.random.default_rng(0), new_colour_buffer(B)
    places = (random.permutation(512)[:60] << 1).astype(np.int16)
    places[:20] = (places[:20] & ~0b0010010010) | 1  # wide cells
    corner, size = np.array([0.3, -1.2, 2.5], np.float32), np.array([0.02, 0.03, 0.025], np.float32)
    evaluate_basis(places, 0, len(places), corner[0], corner[1], corner[2], size[0], size[1], size[2], room)
    place = places.astype(np.int64)
    at = np.stack([place >> 7, place >> 4 & 7, place >> 1 & 7], axis=1) + (1 + (place[:, None] & 1)) / 2
    to = corner + at * size
    expected = sh_basis(to / np.sqrt((to**2).sum(axis=1, keepdims=True)), B)
    assert_allclose(room[4 : 4 + B, : len(places)].T, expected, atol=2e-6)
