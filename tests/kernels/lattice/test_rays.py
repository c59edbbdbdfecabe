"""Samples along rays: a step after the other, by the formula of emission and absorption."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake.kernels.lattice.nodes import RELU, DensityNodes, nearest_in
from nerfbake.kernels.lattice.rays import composite_colours, composite_values, samples_of

LINKS = np.arange(8, dtype=np.int32).reshape(2, 2, 2)
STEP = 0.125


def nodes(density: float) -> DensityNodes:
    mask = np.ones((1, 1, 1), bool)
    return DensityNodes(LINKS, np.full(8, density, np.float32), mask, *nearest_in(mask), 1, RELU, 0.0, 1.0, 0.0)


def test_a_ray_through_a_fog_is_weighed_by_hand() -> None:
    """A box of one world unit, entered a quarter before it: samples at 0.25, 0.375, ... 1.125 along the ray."""
    origin, ways = np.array([-0.25, 0.5, 0.5]), np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    met = samples_of(nodes(3.0), origin, ways, STEP, 0.0)
    assert_array_equal(met.first, [0, 8, 8])  # the second one passes the box by
    assert_allclose(met.places[:, 0], np.arange(8) * STEP)
    kept = np.exp(-3 * STEP)
    weights = (1 - kept) * kept ** np.arange(8)
    assert_allclose(met.weights, weights, rtol=1e-6)
    assert_allclose(met.lost, [[1 - kept**8, (weights * (0.25 + np.arange(8) * STEP)).sum()], [0, 0]])
    colours = np.repeat(np.arange(8, dtype=np.float32)[:, None], 3, axis=1)
    assert_allclose(composite_colours(met, colours)[0], (weights * np.arange(8)).sum(), rtol=1e-6)
    assert_allclose(
        composite_values(met, colours[:, :2] + 1), [[(weights * np.arange(1, 9)).sum()] * 2, [0, 0]], rtol=1e-6
    )


@pytest.mark.parametrize("cut", [0.5, 1e-4])
def test_a_ray_ends_where_little_is_let_through(cut: float) -> None:
    met = samples_of(nodes(16.0), np.array([-1.0, 0.5, 0.5]), np.array([[1.0, 0.0, 0.0]]), STEP, cut)
    through = np.exp(-16 * STEP * np.arange(1, 9))
    assert len(met.weights) == min(int((through >= cut).sum()) + 1, 8)


def test_a_camera_inside_sees_only_what_is_before_it() -> None:
    met = samples_of(nodes(1.0), np.array([0.5, 0.5, 0.5]), np.array([[1.0, 0.0, 0.0]]), STEP, 0.0)
    assert_allclose(met.places[:, 0], 0.5 + np.arange(4) * STEP)


def test_a_hole_in_the_fog_is_passed() -> None:
    """A mask of five nodes along x, of which the second and the fourth count: their samples, and none between."""
    mask = np.zeros((5, 1, 1), bool)
    mask[[1, 3]] = True
    fog = nodes(3.0)._replace(mask=mask, times=nearest_in(mask)[0], plus=nearest_in(mask)[1])
    met = samples_of(fog, np.array([-0.5, 0.5, 0.5]), np.array([[1.0, 0.0, 0.0]]), STEP / 2, 0.0)
    x = (np.arange(16) * STEP / 2)[[2, 3, 4, 5, 10, 11, 12, 13]]
    assert_allclose(met.places[:, 0], x)
    kept = np.exp(-3 * STEP / 2)
    assert_allclose(met.weights, (1 - kept) * kept ** np.arange(8), rtol=1e-6)
    assert_allclose(met.lost[0], [1 - kept**8, (met.weights * (0.5 + x)).sum()], rtol=1e-6)
