"""Splats rounded for a page: how far they are from what they were."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from nerfbake import Splats, build_page_splats, orbit_cameras, render_splats
from tests.support.splats import splats


def nearest(scene: Splats, found: Splats) -> np.ndarray:
    """The number of the splat of `found` that each splat of `scene` became."""
    return np.array([((found.means - mean) ** 2).sum(axis=1).argmin() for mean in scene.means])


@given(st.integers(1, 40), st.integers(0, 4), st.integers(0, 9))
def test_what_is_restored_is_as_near_as_is_promised(n: int, degree: int, seed: int) -> None:
    scene = splats(n, degree=degree, seed=seed)
    page = build_page_splats(scene)
    found = page.restored()
    order = nearest(scene, found)
    assert sorted(order) == list(range(n))
    assert (found.n, found.degree) == (n, degree)
    assert np.abs(found.means[order] - scene.means).max() <= 0.51 * page.step + 1e-6
    assert np.abs(np.log(found.scales[order] / scene.scales)).max() <= 0.5 / 16 + 1e-6
    assert np.abs(found.opacity[order] - scene.opacity).max() <= 0.51 / 255
    assert (np.abs((found.quats[order] * scene.quats).sum(axis=1)) > 0.9999).all()
    assert np.abs(found.sh[order, 0] - scene.sh[:, 0]).max() <= 0.501 / 64
    assert np.abs(found.sh[order, 1:] - scene.sh[:, 1:]).max(initial=0) <= 0.501 / 32


def test_pictures_lose_little() -> None:
    scene = splats(300, degree=2)
    found = build_page_splats(scene).restored()
    for camera in orbit_cameras(scene, frames=2, width=80, height=80).cameras:
        error = render_splats(scene, camera).colour - render_splats(found, camera).colour
        assert -10 * np.log10((error**2).mean()) > 45


def test_a_single_far_splat_does_not_cost_the_others_their_digits() -> None:
    scene = splats(300, degree=0)
    scene.means[7] = 5e3
    page = build_page_splats(scene)
    assert page.step < 1e-4
    assert np.abs(page.restored().means[-1] - scene.means[7]).max() < 1e-3  # the last of the curve


@pytest.mark.parametrize("far", [0, 1e9])
def test_all_in_one_place_is_a_page(far: float) -> None:
    scene = replace(splats(5, degree=0), means=np.full((5, 3), far, np.float32), scales=np.zeros((5, 3), np.float32))
    np.testing.assert_allclose(build_page_splats(scene).restored().means, scene.means, rtol=1e-6)


def test_the_largest_numbers_are_clamped() -> None:
    scene = splats(3, degree=1)
    scene.sh[:] = 1e30
    scene.sh[0] = -1e30
    scene.scales[:] = [[0, 1e-30, 1e9]]
    page = build_page_splats(scene)
    assert set(np.abs(page.colours.astype(int)).ravel()) == {32767}
    assert set(np.abs(page.rest.astype(int)).ravel()) == {127}
    found = page.restored()
    assert found.scales.min() < 1e-16
    assert found.scales.max() == pytest.approx(1e9, rel=0.04)


def test_the_same_splats_are_the_same_numbers() -> None:
    scene = splats(100, degree=3)
    again = build_page_splats(scene)
    turned = build_page_splats(replace(scene, quats=-scene.quats))  # the same rotations
    for name in ("places", "scales", "turns", "opacity", "colours", "rest"):
        np.testing.assert_array_equal(getattr(again, name), getattr(turned, name))
