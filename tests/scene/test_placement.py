"""Placements: each step by hand, their order, and that a rotation keeps lengths."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.maths.affine import transform_points
from nerfbake.scene.placement import Move, placement_matrix

POINT = np.array([1.0, 2.0, 3.0])
degrees = st.floats(-720, 720)


def placed(*moves: Move) -> np.ndarray:
    return transform_points(POINT, placement_matrix(moves))


def test_steps_by_hand() -> None:
    assert_array_equal(placed(), POINT)
    assert_array_equal(placed(Move("t", (1, 0, -1))), [2, 2, 2])
    assert_array_equal(placed(Move("s", (2,))), [2, 4, 6])
    assert_array_equal(placed(Move("r", (90, 0, 0))), [1, -3, 2])
    assert_array_equal(placed(Move("r", (0, 90, 0))), [3, 2, -1])
    assert_array_equal(placed(Move("r", (0, 0, -270))), [-2, 1, 3])
    assert_array_equal(placed(Move("r", (90, 90, 0))), placed(Move("r", (90, 0, 0)), Move("r", (0, 90, 0))))


def test_steps_are_applied_in_their_order() -> None:
    assert_array_equal(placed(Move("t", (1, 0, 0)), Move("s", (2,))), [4, 4, 6])
    assert_array_equal(placed(Move("s", (2,)), Move("t", (1, 0, 0))), [3, 4, 6])


@given(st.tuples(degrees, degrees, degrees))
def test_a_rotation_keeps_lengths_and_handedness(angles: tuple[float, ...]) -> None:
    matrix = placement_matrix([Move("r", angles)])[:, :3]
    assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(matrix) > 0
