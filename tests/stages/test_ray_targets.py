from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from nerfbake import Views, build_field, fit_field, memory_limit, orbit_cameras, render_field, sample_n3tree
from nerfbake.scene.packed_pictures import PackedPictures
from nerfbake.scene.schedule import parse_schedule
from nerfbake.stages._ray_targets import KeptTargets, RayTargets, ray_targets
from nerfbake.stages.views_to_field import FitState


@pytest.fixture(scope="module")
def views() -> Views:
    scene = build_field(sample_n3tree(resolution=8))
    cameras = orbit_cameras(scene, frames=3, width=24, height=16)
    pictures = [render_field(scene, camera, background=None).pixels for camera in cameras.cameras]
    return Views(cameras, PackedPictures.of(pictures), (1.0, 1.0, 1.0), True)


def same(a: RayTargets, b: RayTargets) -> bool:
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in RayTargets._fields)


@pytest.mark.parametrize("ring", [None, 1])
def test_kept_targets_are_those_of_the_picture_at_every_scale(views: Views, ring: int | None) -> None:
    kept = KeptTargets(views, ring=ring, depths={})
    for scale, samples in ((2, 1), (2, 1), (2, 2), (1, 2), (2, 1)):
        for view in (2, 0, 1):
            fresh = ray_targets(views, view, scale=scale, samples=samples, ring=ring)
            assert same(kept.of(view, scale=scale, samples=samples, keep=True), fresh)


@pytest.mark.parametrize(
    ("tilt", "places"), [(0.5, ((-3, -1), (1, -3), (-1, 3), (3, 1))), (-0.5, ((-1, -3), (3, -1), (-3, 1), (1, 3)))]
)
def test_tilted_rays_go_through_a_turned_square(views: Views, tilt: float, places: tuple[tuple[int, int], ...]) -> None:
    own = views.take([1])
    tilted = KeptTargets(own, ring=None, depths={}).of(0, scale=1, samples=2, keep=False, tilt=tilt)
    camera = own.cameras.cameras[0]
    for ray, (x, y) in enumerate(places):
        moved = replace(camera, centre=(camera.cx - x / 8, camera.cy - y / 8))
        single = replace(own, cameras=replace(own.cameras, cameras=(moved,)))
        wanted = ray_targets(single, 0, scale=1, samples=1, ring=None)
        assert_array_equal(tilted.targets, wanted.targets)
        assert_allclose(tilted.directions[ray::4], wanted.directions, atol=1e-7)


def test_targets_are_computed_once_as_long_as_they_fit(views: Views, monkeypatch: pytest.MonkeyPatch) -> None:
    read: list[int] = []
    unpack = PackedPictures.__getitem__

    def noted(self: PackedPictures, number: int) -> Any:
        read.append(number)
        return unpack(self, number)

    monkeypatch.setattr(PackedPictures, "__getitem__", noted)

    def visited(kept: KeptTargets, *, keep: bool = True) -> list[int]:
        read.clear()
        for view in (0, 1, 2):
            kept.of(view, scale=1, samples=1, keep=keep)
        return list(read)

    kept = KeptTargets(views, ring=None, depths={})
    assert visited(kept, keep=False) == [0, 1, 2]
    assert visited(kept) == [0, 1, 2]
    assert visited(kept) == []
    assert kept.size == 3 * 24 * 16 * 20
    assert (visited(kept, keep=False), kept.size) == ([], 0)
    assert visited(kept) == [0, 1, 2]
    kept.give_up()
    assert visited(kept) == [0, 1, 2]
    assert (visited(kept), kept.size) == ([0, 1, 2], 0)
    with memory_limit(8 * 24 * 16 * 20):
        kept = KeptTargets(views, ring=None, depths={})
        visited(kept)
        assert visited(kept) == [1, 2]


def test_a_fit_that_keeps_targets_has_the_bytes_of_one_that_keeps_none(
    views: Views, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fitted() -> FitState:
        *_, state = fit_field(
            views, schedule=parse_schedule("cells=8,epochs=1/cells=16,epochs=2"), basis="SH1", exposure=True
        )
        return state

    first = fitted()
    monkeypatch.setattr("nerfbake.stages._ray_targets._SHARE", 1 << 40)
    second = fitted()
    assert_array_equal(first.gains, second.gains)
    assert_array_equal(first.field().values, second.field().values)
    assert np.ptp(first.gains) > 0
