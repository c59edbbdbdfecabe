"""What others make of leaves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.bench.compress import contenders, median_cut


def test_a_median_cut_by_hand() -> None:
    # Longest along x: cut between 1 and 10; then the lower box along y, the upper one along z.
    points = np.array([[0, 0, 0], [1, 5, 0], [10, 0, 0], [11, 0, 7]], np.float32)
    table, box = median_cut(points, 2)
    assert sorted(box.tolist()) == [0, 1, 2, 3]
    assert_array_equal(table[box], points)
    table, box = median_cut(points, 1)
    assert box.tolist() == [0, 0, 1, 1]
    assert_array_equal(table, [[0.5, 2.5, 0], [10.5, 0, 3.5]])


def test_a_box_of_equal_points_stays_whole_and_sound() -> None:
    table, box = median_cut(np.ones((5, 3), np.float32), 4)
    assert_array_equal(table[box], np.ones((5, 3)))


@pytest.mark.parametrize("name", contenders())
@pytest.mark.parametrize("B", [1, 4])
def test_leaves_come_back_as_well_as_there_are_entries(name: str, B: int) -> None:
    values = np.random.default_rng(0).normal(size=(200, 3 * B + 1)).astype(np.float16).astype(np.float32)
    _, pack = contenders()[name]
    packed = pack(b"topology", values)
    assert_allclose(packed.values[:, -1], values[:, -1])
    if name.startswith("palette"):  # MiniBatchKMeans may leave clusters empty
        assert np.square(packed.values - values).mean() < 0.6
    else:  # there is room for every leaf
        assert_allclose(packed.values, values, atol=2e-3)
    assert 0 < len(packed.data) < 200 * (12 * B + 4) + 2**19
