"""Fitting splats: better pictures at several sizes, the same bytes, and what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from nerfbake import (
    Splats,
    Views,
    build_field,
    build_splats,
    build_views,
    fit_splats,
    measure_views,
    orbit_cameras,
    render_field,
    sample_n3tree,
    scatter_cameras,
)
from nerfbake.errors import InvalidScene
from nerfbake.kernels import parallel


def pictures(cameras: object, field: object) -> Views:
    made = [render_field(field, camera, background=None, samples=2).pixels for camera in cameras.cameras]  # type: ignore[attr-defined,arg-type]
    return build_views(cameras, made)  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def scene() -> tuple[Splats, Views, Views, Views]:
    """Splats of a small field; views to fit to, other views to judge by, and those at twice the size."""
    field = build_field(sample_n3tree(resolution=16))
    held_out = orbit_cameras(field, frames=4, width=48, height=48)
    return (
        build_splats(field),
        pictures(scatter_cameras(field, frames=16, edge=48, zoom=1.1), field),
        pictures(held_out, field),
        pictures(held_out.chosen(size=(96, 96)), field),
    )


def mean_psnr(splats: Splats, views: Views) -> float:
    return float(np.mean([error.psnr for error in measure_views(splats, views)]))


def test_fitted_splats_are_better_in_other_views_and_sizes(scene: tuple[Splats, Views, Views, Views]) -> None:
    splats, views, held_out, large = scene
    before = splats.means.copy()
    *_, state = fit_splats(splats, views, epochs=8)
    fitted = state.splats()
    assert mean_psnr(fitted, held_out) > mean_psnr(splats, held_out) + 3
    assert mean_psnr(fitted, large) > mean_psnr(splats, large) + 2
    assert_array_equal(splats.means, before)  # the input stays as it is
    assert (state.epoch, state.view) == (8, 0)
    assert fitted.antialiased
    moved = np.abs(fitted.means - state.arrays.means[state.arrays.opacity >= 1 / 255])
    assert 0 < moved.max() <= fitted.scales.max(axis=1).min() / 64
    assert not fitted.problems()


def test_the_same_seed_gives_the_same_bytes(
    scene: tuple[Splats, Views, Views, Views], monkeypatch: pytest.MonkeyPatch
) -> None:
    splats, views, *_ = scene
    found = []
    for threads, seed in ((1, 0), (3, 0), (1, 1)):
        monkeypatch.setattr(parallel, "cores", lambda threads=threads: threads)
        *_, state = fit_splats(splats, views.take(range(5)), epochs=1, seed=seed)
        found.append(state.splats())
    for name in ("means", "scales", "quats", "opacity", "sh"):
        assert_array_equal(getattr(found[0], name), getattr(found[1], name))
    assert (found[0].means != found[2].means).any()


def test_what_cannot_be_fitted_is_one_line(scene: tuple[Splats, Views, Views, Views]) -> None:
    splats, views, *_ = scene
    with pytest.raises(InvalidScene, match="epochs are 0; allowed: 1 or more"):
        next(fit_splats(splats, views, epochs=0))
    with pytest.raises(InvalidScene, match="opacity"):
        next(fit_splats(replace(splats, opacity=splats.opacity + 2), views))


def test_splats_that_start_flat_or_transparent_can_be_fitted(scene: tuple[Splats, Views, Views, Views]) -> None:
    splats, views, *_ = scene
    flat = replace(splats, scales=splats.scales * np.array([1, 1, 0], np.float32), opacity=np.round(splats.opacity))
    *_, state = fit_splats(flat, views, epochs=1)
    assert not state.splats().problems()
