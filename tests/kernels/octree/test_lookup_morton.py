from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake.kernels.octree.lookup import dilate


def test_bits_are_spread_by_three() -> None:
    x = np.concatenate([np.arange(300), 2 ** np.arange(21), [2**21 - 1]])
    expected = [sum((int(number) >> bit & 1) << 3 * bit for bit in range(21)) for number in x]
    assert_array_equal(dilate(x), expected)
