"""A field's values fitted anew: its cells stay, and it looks more like the pictures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import (
    BrickField,
    Views,
    build_field,
    build_views,
    measure_views,
    refit_bricks,
    render_field,
    scatter_cameras,
)
from nerfbake.stages._bricks import cells_of_field, field_of_cells
from tests.support.brick_fields import some_brick_field


@pytest.fixture(scope="module")
def field() -> BrickField:
    return some_brick_field(share=0.2)


@pytest.fixture(scope="module")
def views(field: BrickField) -> Views:
    shown = build_field(field)
    cameras = scatter_cameras(shown, frames=8, edge=40)
    return build_views(cameras, [render_field(shown, each, background=None).pixels for each in cameras.cameras])


def psnr(field: BrickField, views: Views) -> float:
    return float(np.mean([error.psnr for error in measure_views(build_field(field), views)]))


def test_a_field_goes_into_the_fit_and_comes_back(field: BrickField) -> None:
    back = field_of_cells(cells_of_field(field), field.box, field.basis)
    back.require_usable()
    for name in ("resolution", "box", "top", "rows"):
        assert_array_equal(getattr(back, name), getattr(field, name))
    assert_allclose(back.values, field.values, rtol=1e-6)


def test_a_field_that_was_spoilt_comes_nearer_to_its_pictures_again(field: BrickField, views: Views) -> None:
    random = np.random.default_rng(0)
    noise = random.normal(0, 1, field.values.shape).astype(np.float32)
    noise[:, -1] = 0
    spoilt = replace(field, values=field.values + noise)
    *_, state = refit_bricks(spoilt, views, epochs=3, samples=1)
    found = state.field()
    assert_array_equal(found.rows, field.rows)
    assert psnr(found, views) > psnr(spoilt, views) + 3


def test_what_no_picture_sees_stays_as_it_was(field: BrickField, views: Views) -> None:
    *_, state = refit_bricks(field, views.take([0, 0]), epochs=1, samples=1)
    seen: npt.NDArray[np.bool_] = np.any(state.cells.means, axis=1)
    assert 0 < np.count_nonzero(seen) < len(seen)
    assert_allclose(state.field().values[~seen], field.values[~seen], rtol=1e-6)


def test_the_same_seed_gives_the_same_values(field: BrickField, views: Views) -> None:
    found = [list(refit_bricks(field, views, epochs=1, seed=seed))[-1].field().values for seed in (0, 0, 1)]
    assert_array_equal(found[0], found[1])
    assert (found[0] != found[2]).any()
