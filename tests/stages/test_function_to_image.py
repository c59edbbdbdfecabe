from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, bake_function, measure_function, render_function
from nerfbake.errors import InvalidScene
from nerfbake.scene.camera import look_at
from nerfbake.stages.function_to_part import FunctionPart, cameras_of
from nerfbake.stages.scene_to_field import build_field
from tests.support.functions import DENSITY, LEAN, REACH, TURN, soft_field

BOX = np.array([[-1.0] * 3, [1.0] * 3])
AHEAD = Camera(9, 9, 30.0, look_at(np.zeros(3), 0.0, 0.0, 4.0))  # from x = 4


def test_a_ray_through_the_middle_is_the_integral() -> None:
    image = render_function(soft_field(), AHEAD, background=(0.0, 0.0, 0.0), transmittance_cut=0)
    alpha = 1 - np.exp(-DENSITY * REACH)
    assert_allclose(image.alpha[4, 4], alpha, rtol=1e-4)
    assert_allclose(image.colour[4, 4], alpha / (1 + np.exp(LEAN @ [1, 0, 0])), rtol=1e-3)
    # The density rises along the ray, so that the mean of 1 - e^-(...) has no simple form: a fine sum.
    t = np.linspace(4 - REACH, 4 + REACH, 100_001)
    sigma = DENSITY * (1 - np.abs(t - 4) / REACH)
    passed = np.exp(-np.concatenate([[0], np.cumsum((sigma[1:] + sigma[:-1]) / 2 * np.diff(t))]))
    assert_allclose(image.depth[4, 4], (sigma * passed * t).sum() / (sigma * passed).sum(), rtol=1e-3)
    assert image.alpha[0, 0] == 0


def test_the_background_is_behind_and_the_last_sample_replaces_it() -> None:
    image = render_function(soft_field(), AHEAD, background=(0.25, 0.5, 1.0))
    assert_allclose(image.colour[0, 0], [0.25, 0.5, 1.0])
    field = soft_field(background="last", contracted=True, far=100.0)
    image = render_function(field, AHEAD)
    look = AHEAD.rays()[1][0]
    assert_allclose(image.colour[0, 0], 1 / (1 + np.exp(-LEAN @ look)), rtol=1e-5)
    assert (image.alpha == 1).all()


def test_contraction_changes_nothing_inside_of_the_cube() -> None:
    plain = render_function(soft_field(), AHEAD)
    whole = render_function(soft_field(contracted=True, far=100.0), AHEAD)
    assert_allclose(whole.colour, plain.colour, atol=1e-4)


def test_a_turned_field_gives_the_same_pictures_in_its_world() -> None:
    turn = np.linalg.inv(TURN[:, :3])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = 2 * turn @ AHEAD.pose[:3, :3], turn @ (AHEAD.pose[:3, 3] - TURN[:, 3])
    turned = render_function(soft_field(frame=TURN), replace(AHEAD, pose=pose))
    plain = render_function(soft_field(), AHEAD)
    assert_allclose(turned.colour, plain.colour, atol=1e-5)
    assert_allclose(turned.depth * 2, plain.depth, rtol=1e-4)


def test_empty_cells_are_passed_over_without_a_difference() -> None:
    field, every = soft_field(), soft_field()
    every.__dict__["filled"] = np.ones((1, 1, 1), bool)
    assert field.filled.mean() < 0.3
    assert_allclose(render_function(field, AHEAD).colour, render_function(every, AHEAD).colour, atol=1e-3)


def test_rays_begin_at_near() -> None:
    behind = render_function(soft_field(near=4.0), AHEAD, background=None)
    assert_allclose(behind.alpha[4, 4], 1 - np.exp(-DENSITY * REACH / 2), rtol=1e-3)


def test_threads_change_no_byte(monkeypatch: pytest.MonkeyPatch) -> None:
    pictures = []
    for threads in ("1", "3"):
        monkeypatch.setenv("NUMBA_NUM_THREADS", threads)
        pictures.append(render_function(soft_field(), AHEAD).colour)
    assert_array_equal(pictures[0], pictures[1])


def test_the_loss_of_a_bake_and_the_light_outside_of_it() -> None:
    field = soft_field()
    cameras = cameras_of(field).few(3, 24)
    whole = bake_function(field, resolution=32, basis="SH4", part=FunctionPart(BOX, 1))
    found = measure_function(field, build_field(whole), cameras, BOX)
    assert found.psnr > 40
    assert found.outside == 0
    half = np.array([[-1.0] * 3, [1.0, 1.0, 0.0]])
    cut = measure_function(field, build_field(whole), cameras, half)
    assert 0.01 < cut.outside < 0.5


def test_a_cut_out_of_range_is_refused() -> None:
    with pytest.raises(InvalidScene, match="transmittance_cut is 1; allowed: 0 to 1, excluding 1"):
        render_function(soft_field(), AHEAD, transmittance_cut=1.0)
