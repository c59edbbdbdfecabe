"""Matrix products: sums in order, on one thread and on all."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.maths.linear import _SMALL, product


def test_a_few_rows_have_the_bits_of_many() -> None:
    random = np.random.default_rng(0)
    a, b = random.normal(size=(9000, 20)), random.normal(size=(20, 300))
    assert a.size * 300 > _SMALL > a[:100].size * 300
    whole = product(a, b)
    assert_allclose(whole, a @ b, rtol=1e-10, atol=1e-12)
    assert_array_equal(product(a[:100], b), whole[:100])
