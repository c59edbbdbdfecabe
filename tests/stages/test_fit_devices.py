"""Fits on a software device against the kernels of the CPU: the same sums, nearly the same cells, the same quality."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Camera, Views, build_field_from_bricks, carve_hull, fit_field, measure_views, refit_bricks
from nerfbake.device.fit import FitPasses, Losses
from nerfbake.device.gpu import Gpu
from nerfbake.errors import DeviceError
from nerfbake.kernels.fit.ties import Ties
from nerfbake.kernels.fit.update import LearningRates
from nerfbake.scene.camera import Cameras, look_at
from nerfbake.scene.lens import Lens
from nerfbake.scene.schedule import Schedule, parse_schedule
from nerfbake.stages._bricks import BrickCells
from nerfbake.stages._depth_map import DepthMap
from nerfbake.stages._fit_devices import CpuFit, FitDevice, GpuFit, Look, Visit
from nerfbake.stages.views_to_field import FitState, measure_state
from tests.stages.test_scenery import cameras, pictures_of, room
from tests.support.brick_fields import some_shells
from tests.support.device import opened
from tests.support.views import sample_views

SHORT = parse_schedule(
    "cells=16,scale=2,epochs=2,density=0.3..0.05,colour=0.5..0.2,prune=0.03/cells=32,epochs=2,prune=0.02/"
    "cells=32,epochs=2,rays=2,split=0.2,prune=0.005"
)
ROOM = parse_schedule("cells=32,scale=2,epochs=1,density=0.05..0.03/cells=32,epochs=1,density=0.03..0.01,split=0.3")


@pytest.fixture(scope="module")
def gpu() -> Iterator[Gpu]:
    found = opened()
    yield found
    found.close()


def last(views: Views, schedule: Schedule = SHORT, **options: Any) -> FitState:
    *_, state = fit_field(views, schedule=schedule, **options)
    return state


def shown(state: FitState, views: Views) -> float:
    errors = measure_views(build_field_from_bricks(state.field()), views, samples=2)
    return float(np.mean([error.psnr for error in errors]))


def visits(count: int, losses: Losses, gains: Any = None) -> list[Visit]:
    steps = LearningRates(0.1, 0.4, np.ones(1, np.float32), np.full(1, 0.004, np.float32), 4.0)
    return [Visit(losses, gains, steps, number == 0) for number in range(count)]


def depths_of(views: Views) -> dict[int, DepthMap]:
    """Depths of half as many pixels, which are known for most of them."""
    random, found = np.random.default_rng(4), {}
    for number, camera in enumerate(views.cameras.cameras):
        half = replace(camera.reduced(2), lens=None)
        inverse = random.uniform(0.4, 1.5, (half.height, half.width))
        found[number] = DepthMap(half, inverse, inverse < 1.2, 0.1, np.zeros(inverse.shape, np.float32))
    return found


def visited(device: FitDevice, views: Views, cells: BrickCells, losses: Losses, gains: Any = None) -> Any:
    """The sums of visits of all views, and the cells after them."""
    count = len(views.pictures)
    device.begin(views, depths_of(views), (Look(number, 1, 2, None, False) for number in range(count)))
    sums = device.visit(cells, visits(count, losses, gains), counted=True) if isinstance(device, GpuFit) else None
    if sums is None:
        sums = np.concatenate([device.visit(cells, [each], counted=True) for each in visits(count, losses, gains)])
    device.read_back(cells)
    return sums


def room_views(count: int = 1, lens: Lens | None = None) -> Views:
    """Random pictures from within the shells of some_shells()."""
    random, poses = np.random.default_rng(0), [look_at(np.zeros(3), 2.0 * k, 0.3, 1.6) for k in range(count)]
    posed = Cameras(tuple(Camera(28, 20, 20.0, pose, f"{k}", lens=lens) for k, pose in enumerate(poses)))
    pictures = random.integers(0, 256, (count, 20, 28, 4), np.uint8)
    pictures[..., 3] = 255
    return Views(posed, tuple(pictures), (1.0, 0.9, 0.8), False, scenery=True)


@pytest.mark.long
@pytest.mark.parametrize(
    ("lens", "losses", "gains"),
    [
        (None, Losses(1.6), None),
        (None, Losses(1.6, 0.08, 0.05, 0.2), np.array([1.2, 0.9, 0.8])),
        (None, Losses(1.6, 0.08, 0.05, depth=0.3), None),
        (Lens("polynomial", (0.3,)), Losses(1.6, 0.08, 0.05, depth=0.3), None),
        (Lens("fisheye", (0.1,)), Losses(1.6, most=0.3), None),
    ],
)
def test_one_view_of_cells_of_two_widths_in_shells(gpu: Gpu, lens: Any, losses: Losses, gains: Any) -> None:
    views, own, theirs, before = room_views(lens=lens), some_shells(), some_shells(), some_shells()
    sums = visited(CpuFit(), views, own, losses, gains)
    assert_allclose(visited(GpuFit(gpu), views, theirs, losses, gains), sums, rtol=1e-5)
    moved = np.abs(own.bricks.values - before.bricks.values)
    assert (moved > 0.01).sum() > 100
    # A ray may miss a cell whose corner it cuts on the CPU. Such cells get steps of few digits, or none.
    assert (np.abs(theirs.bricks.values - own.bricks.values) > 0.005).sum() <= 8
    for found, wanted in (theirs.means, own.means), (theirs.seen, own.seen):
        assert (np.abs(found - wanted) > 1e-5 + 1e-3 * wanted).sum() <= 16


@pytest.mark.long
def test_values_in_two_bindings_are_those_in_one(gpu: Gpu, monkeypatch: pytest.MonkeyPatch) -> None:
    views, one, two = room_views(), some_shells(), some_shells()
    visited(GpuFit(gpu), views, one, Losses(1.6))
    half = len(one.bricks.slots) // 2
    monkeypatch.setattr(FitPasses, "_ranges", lambda *_: iter([(0, half), (half, len(one.bricks.slots))]))
    visited(GpuFit(gpu), views, two, Losses(1.6))
    assert_array_equal(one.bricks.values, two.bricks.values)
    assert_array_equal(one.seen, two.seen)


def test_cells_are_tied_on_the_device_and_stay_there(gpu: Gpu) -> None:
    own, theirs, device = some_shells(), some_shells(), GpuFit(gpu)
    for cells in own, theirs:
        cells.means[:] = np.random.default_rng(3).random((cells.n, 2))
    before, ties = own.bricks.values.copy(), Ties(np.full(1, 0.5, np.float32), 0.2, 0.3)
    for _ in range(2):
        device.tie(theirs, ties)
        CpuFit().tie(own, ties)
    assert_array_equal(theirs.bricks.values, before)
    device.read_back(theirs)
    assert np.abs(own.bricks.values - before).max() > 0.1
    assert_allclose(theirs.bricks.values, own.bricks.values, atol=1e-5)


@pytest.mark.long
def test_a_whole_fit_is_as_good_and_the_same_bytes_on_every_run(gpu: Gpu) -> None:
    views = sample_views()
    own, theirs, again = last(views), last(views, gpu=gpu), last(views, gpu=gpu)
    for name, array in theirs.arrays().items():
        assert_array_equal(array, again.arrays()[name])
    assert abs(shown(own, views) - shown(theirs, views)) < 0.1
    assert abs(measure_state(theirs, views, samples=2) - measure_state(own, views, samples=2)) < 0.1


@pytest.mark.long
def test_a_fit_on_a_device_goes_on_from_a_checkpoint_to_the_same_bytes(
    gpu: Gpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    views = sample_views()
    whole = last(views, gpu=gpu)
    monkeypatch.setattr(FitPasses, "size", lambda _: 5)
    for state in fit_field(views, schedule=SHORT, gpu=gpu):
        arrays = state.arrays()
        if state.stage == 1 and state.view:
            break
    resumed = last(views, gpu=gpu, start=FitState.of_arrays(arrays))
    for name, array in whole.arrays().items():
        assert_array_equal(array, resumed.arrays()[name])


@pytest.mark.long
def test_after_an_error_of_the_device_the_cpu_goes_on_from_what_was_read(
    gpu: Gpu, monkeypatch: pytest.MonkeyPatch
) -> None:
    views, visit, left = sample_views(), FitPasses.visit, 3

    def lost(passes: FitPasses, visits: Any, **options: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise DeviceError("the device is lost")
        return visit(passes, visits, **options)

    monkeypatch.setattr(FitPasses, "visit", lost)
    monkeypatch.setattr(FitPasses, "size", lambda _: 5)
    states = fit_field(views, schedule=SHORT, gpu=gpu)
    state = next(states)
    read = {name: array.copy() for name, array in state.arrays().items()}
    with pytest.raises(DeviceError, match="lost"):
        list(states)
    assert state.view == 5
    for name, array in state.arrays().items():
        assert_array_equal(array, read[name])
    assert last(views, start=state).done


@pytest.mark.long
def test_a_fit_of_scenery_is_as_good(gpu: Gpu) -> None:
    views = pictures_of(room(), cameras(edge=32))
    own, theirs = (last(views, ROOM, basis="SH1", exposure=True, gpu=each) for each in (None, gpu))
    assert abs(shown(own, views) - shown(theirs, views)) < 0.1
    assert_allclose(own.gains, theirs.gains, atol=0.01)


@pytest.mark.long
def test_a_refit_is_as_good(gpu: Gpu) -> None:
    views = sample_views()
    coarse = carve_hull(views, resolution=16)
    own, theirs = ([*refit_bricks(coarse, views, epochs=3, gpu=each)][-1] for each in (None, gpu))
    assert shown(own, views) > 15
    assert abs(shown(own, views) - shown(theirs, views)) < 0.1
