"""The order of depth, and the bounds of what a splat may reach."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake.kernels.splat.project import log_above, sort_by_depth


def test_the_order_is_that_of_a_stable_sort() -> None:
    random = np.random.default_rng(0)
    keys = random.choice(np.array([0, 1e-38, 0.01, 1, 1.0000001, 2.5, 700, 1e15], np.float32), 5000)
    keys[2000:] = random.lognormal(size=3000)
    order = sort_by_depth(keys)
    assert_array_equal(order, [i for i in np.argsort(keys, kind="stable") if keys[i] > 0])
    assert len(sort_by_depth(np.zeros(3, np.float32))) == 0


def test_the_bound_of_the_logarithm_is_above_and_close() -> None:
    for x in np.linspace(1, 255, 1000).tolist():
        assert np.log(x) <= log_above(x) <= 1.01 * np.log(x) + 1e-12
