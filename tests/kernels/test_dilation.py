from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake.kernels.dilation import dilated


@pytest.mark.parametrize("shape", [(1, 1, 1), (2, 1, 3), (5, 7, 9)])
def test_each_and_its_26_neighbours(shape: tuple[int, int, int]) -> None:
    held = np.random.default_rng(0).random(shape) < 0.05
    before, around = held.copy(), np.pad(held, 1)
    expected = np.zeros(shape, bool)
    for x, y, z in product(range(3), repeat=3):
        expected |= around[x : x + shape[0], y : y + shape[1], z : z + shape[2]]
    assert_array_equal(dilated(held), expected)
    assert_array_equal(held, before)
