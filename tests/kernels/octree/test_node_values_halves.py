from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake.kernels.octree.node_values import to_float32


def test_every_finite_half_is_widened_exactly() -> None:
    halves = np.arange(1 << 16, dtype=np.uint16).view(np.float16)
    halves = halves[np.isfinite(halves)]
    assert_array_equal(to_float32(halves).view(np.uint32), halves.astype(np.float32).view(np.uint32))


def test_what_is_wide_already_stays_as_it_is() -> None:
    wide = np.array([1, np.nan], np.float32)
    assert to_float32(wide) is wide
