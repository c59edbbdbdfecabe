"""tiny-cuda-nn's flat parameters: published sizes, levels in float32, dense levels that wrap, ones as padding."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.errors import InvalidFile
from nerfbake.formats.field import tcnn
from tests.support.nerfstudio import random, tcnn_grid, tcnn_mlp


def growth(most: float, base: int, levels: int) -> np.float32:
    return np.float32(np.exp((np.log(most) - np.log(base)) / (levels - 1)))


def test_sizes_are_those_of_the_programs() -> None:
    """nerfacto's two arrays, and the parameters of an instant-ngp snapshot that other loaders state."""
    rows = tcnn.rows_of(tcnn.Grid(16, 2, 19, 16, growth(2048, 16, 16)))
    assert rows == 6_098_120
    trunk, head = tcnn.Perceptron(32, 64, 1, 16, False), tcnn.Perceptron(63, 64, 2, 3, True)
    assert trunk.numbers + 2 * rows == 12_199_312
    assert head.numbers == 9_216
    assert trunk.numbers + tcnn.Perceptron(32, 64, 2, 3, True).numbers + 2 * rows == 12_206_480
    assert tcnn.width_for(9_216, inputs=63, hidden=2, outputs=3, name="a") == 64


# Printed by C with glibc: float b = exp((log(most) - log(16)) / (levels - 1)); exp2f(l * log2f(b)) * 16 - 1.0f.
SCALES = {
    (5, 128): "15 25.9086857 44.2548332 75.1092529 127",
    (8, 4096): "15 34.330864 77.0168686 171.275208 379.414459 839.023193 1853.92151 4094.99854",
    (16, 2048): "15 21.1106052 29.5549297 41.2242508 57.3502312 79.6349258 110.43045 152.987152 211.796829 293.06665 "
    "405.374481 560.574158 775.04657 1071.42883 1481.00269 2046.99866",
    (16, 32768): "15 25.5996132 43.2212143 72.5167007 121.219734 202.187347 336.794037 560.574341 932.603882 "
    "1551.09412 2579.3186 4288.71631 7130.55127 11855.0332 19709.3594 32767",
}


@pytest.mark.parametrize(("levels", "most"), SCALES)
def test_scales_are_rounded_as_in_c(levels: int, most: int) -> None:
    grid = tcnn.Grid(levels, 2, 19, 16, growth(most, 16, levels))
    assert_array_equal(tcnn.layout_of(grid)[1], np.array(SCALES[levels, most].split(), np.float32))


def test_without_rounding_a_level_would_have_a_node_more() -> None:
    """2^(4 log2 b) is 8.00000004 for b in float32: 129 nodes, where tiny-cuda-nn has 128."""
    grid = tcnn.Grid(5, 2, 19, 16, growth(128, 16, 5))
    assert np.ceil(float(grid.growth) ** 4 * 16 - 1) + 1 == 129
    assert np.ceil(tcnn.layout_of(grid)[1][-1]) + 1 == 128
    first, *_ = tcnn.layout_of(grid._replace(log2_rows=24))
    assert first[-1] - first[-2] == 128**3


@pytest.mark.parametrize("features", [1, 2, 4, 8])
def test_grids_follow_the_kernel_up_to_the_faces_of_the_cube(features: int) -> None:
    """Dense levels of 3^3 and 5^3 nodes (28 is 27 rounded up to 8s), then hashed ones; x = 1 wraps in a dense one."""
    grid = tcnn.Grid(5, features, 7, 3, growth(20, 3, 5))
    first, _, dense = tcnn.layout_of(grid)
    assert first.tolist()[:2] == [0, 32]
    assert (dense > 0).tolist() == [True, True, False, False, False]
    params = random(int(first[-1]) * features)
    points = np.random.default_rng(1).random((200, 3)).astype(np.float32)
    points[:8] = [[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)]
    points[8:40, 1] = 1
    found = tcnn.hash_grid_of(params, grid, "params")(points).T
    expected = tcnn_grid(params, points, levels=5, log2=7, base=3, growth=float(grid.growth), F=features)
    assert_allclose(found, expected, atol=1e-6)


def test_inputs_of_the_padding_are_ones_and_its_outputs_are_nothing() -> None:
    x = random(40, 21, seed=3)
    for ones in (True, False):
        sizes = tcnn.Perceptron(21, 48, 3, 5, ones)
        params = random(sizes.numbers, seed=4, scale=0.2)
        expected = tcnn_mlp(params, x, width=48, hidden=3, outputs=5, fill=float(ones))
        mlp = tcnn.mlp_of(params, sizes, "params")
        assert mlp.outputs == 5
        assert_allclose(mlp(np.ascontiguousarray(x.T)).T, expected, atol=1e-5)
        changed = params.copy()
        changed[-11 * 48 :] = 7  # the rows after the fifth of the last matrix
        assert_array_equal(tcnn.mlp_of(changed, sizes, "params").weights[-1], mlp.weights[-1])
    assert mlp.biases[0].any() == ones


def test_no_hidden_layer_is_one_matrix() -> None:
    sizes = tcnn.Perceptron(3, 64, 0, 1, True)
    assert sizes.shapes == [(16, 16)]
    params = random(256)
    expected = params[:3].sum() + params[3:16].sum()
    assert_allclose(tcnn.mlp_of(params, sizes, "params")(np.ones((3, 1), np.float32))[0, 0], expected, rtol=1e-5)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"levels": 1 << 40}, "has 1099511627776 as the levels"),
        ({"features": 1 << 20}, "has 1048576 as the features per level"),
        ({"log2_rows": 63}, "has 63 as the log2 of the rows"),
        ({"base": 0}, "has 0 as the nodes of the first level"),
        ({"growth": np.float32(np.nan)}, "grows by nan"),
        ({"growth": np.float32(np.inf)}, "grows by inf"),
        ({"growth": np.float32(1e5)}, "nodes along an axis; allowed: below 16,777,216"),
    ],
)
def test_sizes_of_no_grid_are_refused(change: dict[str, Any], said: str) -> None:
    grid = tcnn.Grid(16, 2, 19, 16, np.float32(1.38))._replace(**change)

    def asked() -> None:
        tcnn.require_grid(grid, "encoding")
        tcnn.layout_of(grid)

    with pytest.raises(InvalidFile) as error:
        asked()
    assert said in str(error.value)
