from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake.kernels.fit.bricks import top_grid


def test_distances_are_those_to_the_nearest_brick() -> None:
    held = np.zeros((4, 4, 4), bool)
    held[0, 0, 0] = held[3, 0, 1] = True
    top, bricks = top_grid(held), np.argwhere(held)
    for place in np.ndindex(4, 4, 4):
        away = int(np.abs(bricks - place).max(axis=1).min())
        assert (-top[place] if away else 0) == away, place
    assert_array_equal(top[held], [0, 1])
    assert_array_equal(top_grid(np.zeros((2, 2, 2), bool)), np.full((2, 2, 2), -2))
