"""Splats at voxels, against the formulas in float64, all splats at all voxels."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose

from nerfbake import Splats
from nerfbake.kernels.maths.elementary import fibonacci
from nerfbake.kernels.splat.voxels import count_in_bricks, fill_bricks, gaussians_of, list_in_bricks
from tests.support.splats import splats

Floats = npt.NDArray[np.float64]
H = 0.125
LOW = np.array([-1.0, -0.5, -1.5])


def axes_of(quat: Floats) -> Floats:
    w, x, y, z = quat
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def expected(scene: Splats, size: tuple[int, int, int], h: float = H) -> tuple[Floats, Floats]:
    """Optical depths (W, H, D) of a voxel's edge, and colours (W, H, D, 3 B) weighted by them."""
    centres = LOW + h * (np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), -1) + 0.5)
    depths, sums = np.zeros(size), np.zeros((*size, 3 * scene.B))
    ways = fibonacci(4096)
    for i in range(scene.n):
        axes, scales = axes_of(scene.quats[i].astype(np.float64)), scene.scales[i].astype(np.float64)
        covariance = axes @ np.diag(scales**2) @ axes.T
        blurred = covariance + h * h / 12 * np.eye(3)
        opacity = min(float(scene.opacity[i]), 0.99)
        through = np.sqrt(2 * np.pi) / np.sqrt(((ways / scales) ** 2).sum(axis=1)).mean()
        peak = -np.log(1 - opacity) / through
        peak *= np.sqrt(np.linalg.det(covariance) / np.linalg.det(blurred))
        away = centres - scene.means[i]
        square = np.einsum("...i,ij,...j", away, np.linalg.inv(blurred), away)
        own = h * peak * np.where(square < 9, np.exp(-square / 2), 0)
        depths += own
        sums += own[..., None] * scene.sh[i].T.reshape(-1)
    return depths, sums / np.maximum(depths, 1e-30)[..., None]


def filled(scene: Splats, size: tuple[int, int, int], h: float = H) -> tuple[Floats, Floats]:
    """The same by the kernels."""
    gaussians = gaussians_of(scene.means, scene.scales, scene.quats, scene.opacity, LOW, h)
    counts = np.zeros(tuple(-(-edge // 8) for edge in size), np.int32)
    count_in_bricks(gaussians, counts)
    ends = np.concatenate([[0], np.cumsum(counts, dtype=np.int64)])
    order = np.full(int(ends[-1]), -1, np.int32)
    list_in_bricks(gaussians, 0, ends[:-1].reshape(counts.shape).copy(), order)
    assert (order >= 0).all()
    places = np.argwhere(counts >= 0).astype(np.int32)
    cells = np.empty((512 * len(places), 3), np.int32)
    values = np.empty((len(cells), 3 * scene.B + 1), np.float32)
    colours = np.ascontiguousarray(scene.sh.transpose(0, 2, 1)).reshape(scene.n, -1)
    limits = np.array(size, np.int32)
    count = fill_bricks(gaussians, colours, places, ends, order, limits, 0.0, cells, values)
    depths, sums = np.zeros(size), np.zeros((*size, 3 * scene.B))
    at = tuple(cells[:count].T)
    assert len(np.unique(cells[:count], axis=0)) == count
    depths[at], sums[at] = values[:count, -1], values[:count, :-1]
    return depths, sums


@pytest.mark.parametrize("size", [(16, 8, 24), (13, 9, 21)])
def test_every_voxel_has_all_splats_that_reach_it(size: tuple[int, int, int]) -> None:
    scene = splats(60, degree=1, seed=1)
    scene.scales[:] = 0.02 + 0.2 * np.random.default_rng(2).random((60, 3), np.float32)
    (depths, colours), (found, seen) = expected(scene, size), filled(scene, size)
    assert np.count_nonzero(depths) > 500
    assert ((found > 0) == (depths > 0)).mean() > 0.999  # where a splat ends, rounding decides
    assert_allclose(found, depths, rtol=0.012, atol=2e-3)
    both = (depths > 0.02) & (found > 0)
    assert_allclose(seen[both], colours[both], atol=0.01)


def test_a_ball_has_its_optical_depth_through_the_centre() -> None:
    # Three voxels wide, in the middle of a voxel: the sum along an axis is the integral.
    ball, turn = np.full((1, 3), 3 * H, np.float32), np.array([[1, 0, 0, 0]], np.float32)
    middle = (LOW + H * 12.5)[None].astype(np.float32)
    scene = Splats(middle, ball, turn, np.full(1, 0.8, np.float32), np.zeros((1, 1, 3), np.float32))
    found, _ = filled(scene, (25, 25, 25))
    # The blur takes a hundredth of it, the end at three standard deviations 0.3 %.
    assert_allclose(found[:, 12, 12].sum(), -np.log(1 - 0.8), rtol=0.015)
    assert found[12, 12, 12] == found.max()


def test_a_flat_splat_has_a_finite_density() -> None:
    scene = splats(8, degree=0)
    scene.scales[:, 0] = 0
    scene.scales[4:, 1] = 0
    found, _ = filled(scene, (16, 8, 24))
    assert np.isfinite(found).all()
    thin = splats(8, degree=0)
    thin.scales[:, 0] = 1e-6
    thin.scales[4:, 1] = 1e-6
    assert_allclose(found, filled(thin, (16, 8, 24))[0], atol=1e-3)


def test_a_splat_far_away_and_a_splat_around_everything() -> None:
    scene = splats(3, degree=0)
    scene.means[:] = 0
    scene.means[0], scene.scales[1], scene.scales[2], scene.opacity[:] = 1e15, 1e6, 0.05 * H, 0.5
    found, _ = filled(scene, (16, 8, 24))
    # The second is thinner in every voxel than the third, which is small, between eight voxels.
    assert np.isfinite(found).all()
    assert_allclose(found[found < 1e-5], found.min(), rtol=1e-3)
    assert np.count_nonzero(found > 1e-5) == 8
