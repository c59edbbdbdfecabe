"""Fused depths and opacities of a few samples, by hand."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import build_field
from nerfbake.kernels.surface.fusion import DepthViews, fuse_depths, sample_opacity
from tests.support.scenes import n3tree

WORLD = np.column_stack([np.eye(3), np.zeros(3)])
BRICK = np.zeros((1, 3), np.int32)


def views(*depths: float) -> DepthViews:
    """Cameras 10 above the origin that look straight down on floors at these distances."""
    pose = np.column_stack([np.eye(3), [1.5, 1.5, 10]])
    depth = np.stack([_floor(depth) for depth in depths])
    count = len(depths)
    optics = np.tile([40.0, 40, 32, 32], (count, 1))
    return DepthViews(depth, np.full((count, 2), 64), np.tile(pose, (count, 1, 1)), optics)


def _floor(distance: float) -> npt.NDArray[np.float32]:
    x = (np.arange(64) + 0.5 - 32) / 40
    return np.asarray(distance * np.sqrt(x**2 + x[:, None] ** 2 + 1), np.float32)


def fused(seen: DepthViews) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    total, nearest = np.empty((1, 64), np.float32), np.empty((1, 64), np.float32)
    fuse_depths(BRICK, WORLD, seen, 2.0, total, nearest)
    return total.reshape(4, 4, 4)[1, 1], nearest.reshape(4, 4, 4)[1, 1]


def test_distances_in_front_of_a_floor() -> None:
    # The floor is at z = 1.5: samples at z = 0, 1, 2, 3 are -.75, -.25, .25, .75 truncations in front of it.
    total, nearest = fused(views(8.5))
    np.testing.assert_allclose(total, [-0.75, -0.25, 0.25, 0.75], atol=0.02)
    np.testing.assert_array_equal(total, nearest)


def test_views_are_averaged_and_hidden_samples_get_no_vote() -> None:
    # A second floor 2 above the first hides z = 0 and 1 from its view by more than a truncation.
    total, nearest = fused(views(8.5, 6.5))
    np.testing.assert_allclose(total, [-0.75, -0.25, (0.25 - 0.75) / 2, (0.75 - 0.25) / 2], atol=0.02)
    np.testing.assert_allclose(nearest, [-0.75, -0.25, 0.25, 0.75], atol=0.02)


def test_what_no_view_sees_is_inside_and_sky_is_in_front() -> None:
    assert (fused(views(2.0))[0] == -1).all()
    assert (fused(views(np.inf))[0] == 1).all()


@pytest.mark.parametrize("step", [1, 2])
def test_opacity_of_cells(step: int) -> None:
    data = np.zeros((1, 4, 4, 4, 4), np.float32)
    data[0, 0, 0, :, 3] = [1, 2, 3, 0]
    field = build_field(n3tree(N=4, data=data, data_format="RGBA"))
    out = np.empty((1, 64), np.float32)
    sample_opacity(BRICK, field.cells, field.densities, np.zeros(3), step, 0.5, out)
    column = out.reshape(4, 4, 4)[0, 0]
    density = np.array([1, 2, 3, 0]) if step == 1 else np.array([3 / 8, 3 / 8, 0, 0])
    np.testing.assert_allclose(column, 1 - np.exp(-0.5 * density), rtol=1e-5)
