"""Products of planes and lines at the nodes, against NumPy's sums over all of them."""

from __future__ import annotations

import numpy as np
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.lattice.planes import Factors, values_of

RANDOM = np.random.default_rng(0)


def test_nodes_with_a_row_get_their_sums_and_no_others() -> None:
    X, Y, Z = 3, 4, 5
    shapes = (X, Y, 2), (X, Z, 3), (Y, Z, 1), (Z, 2), (Y, 3), (X, 1), (6, 4)
    xy, xz, yz, z, y, x, matrix = (RANDOM.normal(0, 1, shape).astype(np.float32) for shape in shapes)
    links = np.full((X, Y, Z), -1, np.int32)
    held = RANDOM.random(links.shape) < 0.5
    links[held] = RANDOM.permutation(np.count_nonzero(held))
    out = np.full((np.count_nonzero(held) + 1, 4), 7, np.float32)
    values_of(links, Factors(xy, xz, yz, z, y, x, matrix), out)
    formulas = ("xyr,zr->xyzr", xy, z), ("xzr,yr->xyzr", xz, y), ("yzr,xr->xyzr", yz, x)
    parts = np.concatenate([np.einsum(formula, a, b) for formula, a, b in formulas], axis=3)
    assert_allclose(out[links[held]], (parts @ matrix)[held], rtol=1e-4, atol=1e-5)
    assert_array_equal(out[-1], 7)
