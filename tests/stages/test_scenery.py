"""Fits to pictures with scenery on all sides: the march through shells, the distortion loss, and a small room."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, Cameras, Views, build_field, fit_field, measure_views, render_field
from nerfbake.errors import InvalidScene
from nerfbake.kernels.fit.bricks import BLAME, DENSITY_SUM, ROW, BrickGrid, new_batch
from nerfbake.kernels.fit.rays import SUMS, FitView, march_view
from nerfbake.scene.basis import Basis
from nerfbake.scene.camera import look_at
from nerfbake.scene.schedule import parse_schedule, scenery_schedule
from nerfbake.stages._bricks import cell_places, cells_of_solid, field_of_cells
from nerfbake.stages._fit_state import FitState
from nerfbake.stages._ray_targets import ray_targets
from nerfbake.stages._scenery import focus_distance, inner_cube_of, start_scenery
from nerfbake.stages.views_to_error import plain_psnr
from tests.support.brick_fields import BOX, some_shelled_field, some_shells

WHITE = (1.0, 1.0, 1.0)
NO = np.zeros(0, np.float32)
INSIDE = np.array([0.05, -0.02, 0.1])
SURFACES = np.array([0.0, 0.3, 0.6, 0.9, 1.2, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0, 0.0], np.float32)  # 0: not known
SCHEDULE = parse_schedule(
    "cells=32,scale=2,epochs=6,density=0.05..0.03,prune=0.02/cells=32,epochs=4,density=0.03..0.01,split=0.5,prune=0.01"
)


def cameras(count: int = 28, edge: int = 48, away: float = 1.6) -> Cameras:
    """Cameras on an arc of 100 degrees around the origin, which they look at, at four heights."""
    poses = [look_at(np.zeros(3), 1.75 * i / count, 0.2 * (i % 4) - 0.2, away) for i in range(count)]
    return Cameras(tuple(Camera(edge, edge, 0.9 * edge, pose, f"{i:02d}") for i, pose in enumerate(poses)))


def pictures_of(scene: Any, posed: Cameras) -> Views:
    pictures = tuple(render_field(scene, camera, background=WHITE, samples=2).pixels for camera in posed.cameras)
    opaque = tuple(np.concatenate([each, np.full_like(each[..., :1], 255)], axis=2) for each in pictures)
    return Views(posed, opaque, WHITE, False, scenery=True)


def room() -> Any:
    """A box of coloured plates within walls of coloured tiles, 8 units apart."""
    solid = np.zeros((3, 32, 32, 32), bool)
    solid[0, 10:22, 10:22, 12:20] = True
    solid[2] = True
    solid[2, 1:31, 1:31, 1:31] = False
    cells = cells_of_solid(solid.reshape(-1, 32, 32), BOX, 1, 8.0)
    field = field_of_cells(cells, BOX, Basis("SH", 1))
    random = np.random.default_rng(0)
    shell = np.repeat(np.arange(3), [field.shell(number).n for number in range(3)])
    _, plate = np.unique(np.column_stack([field.corners // 4, shell]), axis=0, return_inverse=True)
    field.values[:, :3] = random.normal(0, 2, (plate.max() + 1, 3))[plate.reshape(-1)]
    return build_field(field)


@pytest.mark.parametrize("shells", [1, 2, 3])
@pytest.mark.parametrize("eye", [[0.1, 0.2, 0.3], [1.3, -0.4, 0.2], [-3.1, 2.2, 1.0], [9.0, 1.0, 2.0]])
def test_rays_through_shells_see_what_the_renderer_sees(shells: int, eye: list[float]) -> None:
    cells = some_shells(shells=shells)
    field = build_field(field_of_cells(cells, BOX, Basis("SH", 1)))
    pose = np.eye(4)
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    pose[:3, :3], pose[:3, 3] = turn * np.linalg.det(turn), eye
    camera = Camera(24, 20, 9.0, pose)
    seen = render_field(field, camera, background=WHITE).colour.reshape(-1, 3)
    views = Views(Cameras((camera,)), (np.zeros((20, 24, 4), np.uint8),), WHITE, False, scenery=True)
    looks = ray_targets(views, 0, scale=1, samples=1, ring=None)
    targets = np.concatenate([seen, np.zeros((len(seen), 1))], axis=1).astype(np.float32)[looks.pixels]
    sums = np.zeros((1, SUMS))
    view = _view(looks.eye, looks.directions, targets, WHITE)
    march_view(cells.bricks, new_batch(1, len(cells.bricks.slots), cells.n), view, sums)
    # Colours come from a short series, and rays end at a transmittance of 1 %.
    assert np.sqrt(sums[0, 0] / seen.size) < 0.004
    if shells == 3 and eye[0] < 8:
        assert seen.std() > 0.02


def _view(eye: Any, directions: Any, targets: Any, background: Any = (0.0, 0.0, 0.0), **fields: Any) -> FitView:
    own: dict[str, Any] = {"distortion": 0.0, "focus": 1.0, "most": np.inf, "most_mean": np.inf, "depth": 0.0}
    own |= {"distances": NO, **fields}
    ground = np.array(background, np.float32)
    return FitView(eye, directions, targets, ground, alpha_weight=0.0, point_weight=0.0, **own)


def density_sums(made: BrickGrid, values: Any, weights: dict[str, float]) -> Any:
    """What these weights of losses ask of the densities, by the kernel's sums."""
    bricks, sums = made._replace(values=values), []
    for own in ({"distortion": 1e-30}, weights):  # the depth loss counts only together with the other
        batch = new_batch(1, len(bricks.slots), len(bricks.places))
        view = _view(INSIDE, _directions(), np.zeros((12, 4), np.float32), focus=1.5, distances=SURFACES, **own)
        march_view(bricks, batch, view, np.zeros((1, SUMS)))
        total = np.zeros((len(bricks.places), ROW))
        for brick, base in enumerate(batch.base[0]):
            if base >= 0:
                start, end = bricks.first[brick], bricks.first[brick + 1]
                total[start:end] += batch.rows[0, base : base + end - start]
        sums.append(total[:, DENSITY_SUM])
    return sums[1] - sums[0]


def _on_rays(bricks: BrickGrid) -> Iterator[tuple[Any, Any, Any]]:
    """The weights of the cells on each ray, their places, and their lengths, with fine steps along the ray."""
    field = field_of_cells(some_shells()._replace(bricks=bricks), BOX, Basis("SH", 1))
    for direction in _directions().astype(np.float64):
        t = np.linspace(0, 8, 40_001)
        middle = (t[1:] + t[:-1]) / 2
        row = field.rows_at(INSIDE + middle[:, None] * direction)
        change = np.flatnonzero(np.diff(row, prepend=-9))
        ends = np.append(change[1:], len(row))
        row, start, end = row[change], t[change], t[ends]
        start, end, row = start[row >= 0], end[row >= 0], row[row >= 0]
        depth = field.values[row, -1].astype(np.float64) * (end - start)
        behind = np.exp(-np.cumsum(depth))
        weight = np.concatenate([[1.0], behind[:-1]]) - behind if len(behind) else behind
        place = _place((start + end) / 2)
        yield weight, place, (end - start) * (2 - place) ** 2 / (4 * 1.5)


def _place(t: Any) -> Any:
    return 2 * (t - 1.5) / (t + 1.5)


def _distortion(bricks: BrickGrid) -> float:
    """Sum over rays of sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 l_i."""
    return sum(
        float((weight[:, None] * weight * np.abs(place[:, None] - place)).sum() + (weight**2 * length).sum() / 3)
        for weight, place, length in _on_rays(bricks)
    )


def _depth_loss(bricks: BrickGrid) -> float:
    """Sum over rays of sum_i w_i a_i: how far before a known surface light comes from, or, up to a limit, behind it."""
    total = 0.0
    for (weight, place, _), surface in zip(_on_rays(bricks), SURFACES.astype(np.float64), strict=True):
        apart = place - _place(surface)
        away = np.where(apart < 0, np.maximum(-apart - 0.02, 0), np.clip(apart - 0.02, 0, 0.03))
        total += float((weight * away).sum()) if surface > 0 else 0.0
    return total


@pytest.mark.parametrize(
    ("weights", "loss_of"),
    [({"distortion": 0.5}, _distortion), ({"distortion": 1e-30, "depth": 0.5}, _depth_loss)],
)
def test_sums_of_losses_along_a_ray_are_their_slopes(weights: Any, loss_of: Callable[[BrickGrid], float]) -> None:
    cells = some_shells()
    made = cells.bricks
    start = np.repeat(made.first[:-1], np.diff(made.first))
    count = np.repeat(np.diff(made.first), np.diff(made.first))
    place = 4 * start + 3 * count + np.arange(cells.n) - start  # of each cell's density
    width = (made.width[(np.argwhere(made.top >= 0)[:, 0] // 8)]).repeat(np.diff(made.first)) * (1 + (made.places & 1))
    values = made.values.copy()
    values[place] *= 0.3  # no ray ends early
    assert loss_of(made._replace(values=values)) > 0
    sums = density_sums(made, values, weights)
    for cell in np.argsort(-np.abs(sums))[:4]:
        losses = []
        for step in (-1e-2, 1e-2):
            moved = values.copy()
            moved[place[cell]] += step
            losses.append(loss_of(made._replace(values=moved)))
        slope = (losses[1] - losses[0]) / 2e-2 * width[cell]
        assert_allclose(sums[cell], -0.5 * slope, rtol=0.03, atol=1e-4)


def _directions() -> Any:
    directions = np.random.default_rng(2).normal(size=(12, 3)) * [0.3, 0.3, 1]
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def test_a_room_is_fitted_with_its_walls() -> None:
    scene, posed = room(), cameras()
    views = pictures_of(scene, posed)
    training, held_out = views.take([i for i in range(28) if i % 7 != 3]), views.take([3, 10, 17, 24])
    *_, state = fit_field(training, schedule=SCHEDULE, basis="SH1")
    field = state.field()
    assert field.shells > 3
    made = build_field(field)
    errors = [error.psnr for error in measure_views(made, held_out, samples=2)]
    assert min(errors) > 20
    assert max(errors) > 30
    for camera in held_out.cameras.cameras[1:3]:
        true, found = (render_field(each, camera, background=WHITE).depth for each in (scene, made))
        assert np.isfinite(found).all()  # the walls are there
        assert np.median(np.abs(found / true - 1)) < 0.15
        assert (found > 0.5 * true).mean() > 0.97  # and no fog is in front of the camera


def brightened(views: Views, gains: Any) -> Views:
    """The views with their colours times the gains (views, 3), and the exact colours to 1/255."""
    pictures = []
    for each, gain in zip(views.pictures, gains, strict=True):
        colour = np.rint(each[..., :3] * gain).clip(0, 255).astype(np.uint8)
        pictures.append(np.concatenate([colour, each[..., 3:]], axis=2))
    return replace(views, pictures=tuple(pictures))


@pytest.mark.long
def test_gains_of_pictures_with_other_exposures_are_found() -> None:
    posed = cameras(20, 24)
    gains = np.where(np.arange(20)[:, None] % 3 == 0, [[0.6, 0.7, 0.8]], 0.9)
    views = brightened(pictures_of(room(), posed), gains)
    *_, state = fit_field(views, schedule=SCHEDULE, basis="SH1", exposure=True)
    assert_allclose(np.exp(np.log(state.gains).mean(axis=0)), 1, rtol=1e-9)
    ratio = state.gains[1::3].mean(axis=0) / state.gains[::3].mean(axis=0)
    assert_allclose(ratio, [0.9 / 0.6, 0.9 / 0.7, 0.9 / 0.8], rtol=0.08)
    *_, fixed = fit_field(views, schedule=SCHEDULE, basis="SH1")
    found = [np.mean([each.corrected for each in measured(made, views)]) for made in (state, fixed)]
    assert found[0] > found[1] + 1


def measured(state: FitState, views: Views) -> Any:
    return measure_views(build_field(state.field()), views, samples=2)


def test_ignored_pixels_have_no_effect() -> None:
    views = pictures_of(room(), cameras(6, 32))
    short = parse_schedule("cells=32,scale=2,epochs=2,density=0.05/cells=32,epochs=1")
    states, errors = [], []
    for colour in (0, 255):
        pictures = [each.copy() for each in views.pictures]
        for each in pictures:
            each[4:14, 3:20, :3], each[4:14, 3:20, 3] = colour, 0
        masked = replace(views, pictures=tuple(pictures), masked=True)
        assert masked.used(0).sum() == 32 * 32 - 10 * 17
        *_, state = fit_field(masked, schedule=short, basis="SH1")
        states.append(state.cells.bricks.values)
        errors.append(measured(state, masked))
    assert_array_equal(states[0], states[1])
    assert plain_psnr(masked) > plain_psnr(replace(masked, masked=False, scenery=False))
    assert errors[0][2].psnr == errors[1][2].psnr


def test_what_one_view_shows_alone_has_a_bounded_effect() -> None:
    # A residual of 1 counts as one of 0.2, and one of 0.1 in full.
    cells = some_shells(shells=1, share=0.3)
    directions, eye = np.array([[0.1, 0.2, -1.0]], np.float32), np.array([0.1, 0.1, 3.0])
    directions /= np.linalg.norm(directions)
    ground, sums, found = np.zeros(3, np.float32), np.zeros((1, SUMS)), []
    for most, beyond in ((9.0, 0.2), (0.2, 1.0), (9.0, 0.1), (0.2, 0.1)):
        batch = new_batch(1, len(cells.bricks.slots), cells.n)
        target = np.ones((1, 4), np.float32)
        view = _view(eye, directions, target, ground, most=most)
        march_view(cells.bricks, batch, view, sums)
        target[0, :3] = np.sqrt(sums[0, 4:]) + beyond  # the rendered colour, and more
        batch = new_batch(1, len(cells.bricks.slots), cells.n)
        march_view(cells.bricks, batch, view, sums)
        found.append(batch.rows[0, : batch.used[0], DENSITY_SUM].copy())
    assert np.abs(found[0]).max() > 0
    assert_allclose(found[0], found[1], rtol=1e-4, atol=1e-7)
    assert_array_equal(found[2], found[3])


def test_what_neighbours_show_together_has_a_bounded_effect() -> None:
    # Equal residuals count less the longer they last; residuals that alternate count in full.
    cells, count = some_shells(shells=1, share=0.3), 200
    look, eye = np.array([0.1, 0.2, -1.0], np.float32), np.array([0.1, 0.1, 3.0])
    directions = np.tile(look / np.linalg.norm(look), (count, 1)).astype(np.float32)
    ground, sums, targets = np.zeros(3, np.float32), np.zeros((1, SUMS)), np.ones((count, 4), np.float32)

    def blame(most_mean: float) -> float:
        batch = new_batch(1, len(cells.bricks.slots), cells.n)
        view = _view(eye, directions, targets, ground, most_mean=most_mean)
        march_view(cells.bricks, batch, view, sums)
        return float(batch.rows[0, : batch.used[0], BLAME].sum())

    blame(np.inf)
    rendered = np.sqrt(sums[0, 4:] / count)
    targets[:, :3] = rendered + 0.1
    lasting = 0.1 * (1 - (63 / 64) ** np.arange(1, count + 1))
    wanted = np.minimum(1, 0.05 / lasting).mean()
    assert 0.5 < wanted < 0.8
    assert blame(0.05) / blame(np.inf) == pytest.approx(wanted, rel=1e-3)
    targets[1::2, :3] = rendered - 0.1
    assert blame(0.05) == pytest.approx(blame(np.inf), rel=1e-6)


def test_a_fit_with_scenery_resumes_with_the_same_bytes() -> None:
    views = pictures_of(room(), cameras(6, 32))
    short = parse_schedule("cells=32,scale=2,epochs=1,density=0.05/cells=32,epochs=1,split=0.3")
    whole: Any = None
    half: Any = None
    for number, whole in enumerate(fit_field(views, schedule=short, basis="SH1", seed=3, exposure=True)):
        if number == 6:
            half = {name: array.copy() for name, array in whole.arrays().items()}
    *_, resumed = fit_field(views, schedule=short, start=FitState.of_arrays(half))
    for name, array in whole.arrays().items():
        assert_array_equal(resumed.arrays()[name], array, err_msg=name)


def test_cameras_at_one_place_need_a_box() -> None:
    posed = cameras(4)
    poses = [camera.pose.copy() for camera in posed.cameras]
    for pose in poses:
        pose[:3, 3] = 0
    still = Cameras(tuple(Camera(16, 16, 14.0, pose, str(i)) for i, pose in enumerate(poses)))
    views = Views(still, (np.full((16, 16, 4), 255, np.uint8),) * 4, WHITE, False, scenery=True)
    with pytest.raises(InvalidScene, match="the cameras are all at the same place; allowed: two places or more"):
        next(iter(fit_field(views, schedule=SCHEDULE)))


@pytest.mark.parametrize(("focal", "edge"), [(8.0, 1.6), (14.0, 1.6), (16.0, 1.6), (32.0, 0.8)])
def test_the_inner_cube_of_long_lenses_is_as_wide_as_what_they_show(focal: float, edge: float) -> None:
    posed = cameras(6, 16)
    lenses = [
        replace(camera, focal=(focal, focal), width=12 if i % 2 else 16) for i, camera in enumerate(posed.cameras)
    ]
    box = inner_cube_of(Cameras(tuple(lenses)))
    assert_allclose(box[1] - box[0], edge, rtol=0.04)  # the cameras are 1.6 from the middle
    assert_allclose(box.mean(axis=0), 0, atol=0.05)


@pytest.mark.parametrize("times", [1, 1.5])
def test_a_wider_inner_cube_clears_no_more_fog_around_the_cameras(times: float) -> None:
    posed = cameras(6, 16)
    views = Views(posed, (np.full((16, 16, 4), 255, np.uint8),) * 6, WHITE, False, scenery=True)
    box, cells, _ = start_scenery(views, times * np.array([[-0.8] * 3, [0.8] * 3]), 32, 1)
    assert focus_distance(views, box) == pytest.approx(1.6, abs=0.05)  # where the cameras are
    shell, corner = cell_places(cells.bricks)
    inner = cells.bricks.low[0] + (corner[shell == 0] + 0.5) * cells.bricks.size[0]
    nearest = min(np.linalg.norm(inner - camera.pose[:3, 3], axis=1).min() for camera in posed.cameras)
    assert 0.25 * 1.6 <= nearest < (0.3 * 1.6 if times > 1 else np.inf)


def test_cameras_within_the_inner_cube_look_half_its_edge_far() -> None:
    posed = cameras(4, away=0.1)
    views = Views(posed, (np.full((48, 48, 4), 255, np.uint8),) * 4, WHITE, False, scenery=True)
    assert focus_distance(views, np.array([[-2.0] * 3, [2.0] * 3])) == 2


def test_schedules_of_scenery_take_longer_for_better_presets() -> None:
    presets = [scenery_schedule(name) for name in ("fast", "balanced", "best")]
    assert sorted(schedule.epochs for schedule in presets) == [schedule.epochs for schedule in presets]
    assert all(schedule[0].cells == 32 and schedule[-1].cells == 128 for schedule in presets)
    assert scenery_schedule(minutes=1) == presets[0]
    assert scenery_schedule(minutes=5) == presets[2]
    assert scenery_schedule(minutes=0.2).epochs < presets[0].epochs
    assert scenery_schedule(minutes=10).epochs > presets[2].epochs
    assert [stage.scale for stage in scenery_schedule("fast", edge=756)] == [16, 8, 4, 2]
    with pytest.raises(InvalidScene, match="preset is 'slow'; allowed: fast, balanced, best"):
        scenery_schedule("slow")
    with pytest.raises(InvalidScene, match="minutes are 0; allowed: above 0"):
        scenery_schedule(minutes=0)


def test_a_field_with_shells_is_rendered_like_its_tree() -> None:
    field = some_shelled_field()
    assert build_field(field).sample(np.array([[0.0, 0.0, 3.0]])).shape == (1, 4)
