from __future__ import annotations

import numpy as np
from numpy.testing import assert_array_equal

from nerfbake.kernels.network.mlp import LANES, pack_layers, run_mlp
from nerfbake.kernels.network.mlp_grid import run_perceptrons


def test_each_point_has_the_bits_of_its_own_perceptron() -> None:
    """More than one block for one of them, none for another, in any order; layers of odd widths."""
    rng = np.random.default_rng(1)
    sizes = [(5, 7), (7, 4), (4, 3)]
    weights = tuple(rng.normal(size=(4, out, inputs)).astype(np.float32) for inputs, out in sizes)
    biases = tuple(rng.normal(size=(4, out)).astype(np.float32) for _, out in sizes)
    which = np.concatenate([np.full(2 * LANES + 3, 2), [0, 3, 0], np.full(LANES, 3)])
    rng.shuffle(which)
    x = rng.normal(size=(5, len(which))).astype(np.float32)
    found = run_perceptrons(pack_layers(weights, biases, (), False), which, x, 3)
    for k in range(4):
        own = pack_layers(tuple(w[k] for w in weights), tuple(b[k] for b in biases), (), False)
        assert_array_equal(found[:, which == k], run_mlp(own, x[:, which == k], 3))


def test_no_point_is_no_result() -> None:
    packed = pack_layers((np.ones((2, 1, 3), np.float32),), (np.ones((2, 1), np.float32),), (), False)
    assert run_perceptrons(packed, np.empty(0, np.int64), np.empty((3, 0), np.float32), 1).shape == (1, 0)
