"""Pages of scenes with scenery, in a real browser."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Camera, Cameras, HeldOut, build_field, jobs, render_field, save
from nerfbake.scene.camera import look_at
from nerfbake.stages.brick_field_to_n3tree import build_n3tree
from tests.support.brick_fields import some_shelled_field
from tests.support.browser import Browser
from tests.support.viewed import decibels

pytestmark = [pytest.mark.tools, pytest.mark.slow]
EDGE = 48


def cameras() -> Cameras:
    """From within the inner cube, from each shell, and from outside of all."""
    places = [0.3, 1.5, 2.9, 7.0]
    poses = [look_at(np.zeros(3), 0.4 + i, 0.3, away) for i, away in enumerate(places)]
    return Cameras(tuple(Camera(EDGE, EDGE, 0.8 * EDGE, pose, str(i)) for i, pose in enumerate(poses)))


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    posed = cameras()
    tree = build_n3tree(some_shelled_field(), dtype="float32")
    held_out = HeldOut.of(posed, [np.zeros((EDGE, EDGE, 3))] * len(posed.cameras))
    path = tmp_path_factory.mktemp("shells") / "a.npz"
    save(path, replace(tree, held_out=held_out))
    return path


def test_the_page_shows_the_scenery_as_render_does(browser: Browser, scene: Path) -> None:
    page_file = scene.with_suffix(".html")
    page = jobs.view_file(str(scene), str(page_file), data="exact")
    assert not page.turns
    assert len(page.around) == 2
    field = build_field(build_n3tree(some_shelled_field(), dtype="float32"))
    with browser.opened(page_file) as seen:
        seen.wait_until_ready()
        assert seen.log == []
        for camera in cameras().cameras:
            wanted = render_field(field, camera).pixels.astype(np.float64)
            assert wanted.std() > 5
            assert decibels(seen.pixels(camera).astype(np.float64), wanted) > 60
        # A crop box shows a part of the inner cube alone; one that is opened again shows the scenery, too.
        outside = cameras().cameras[3]
        opened = seen.pixels(outside, clip=[[0, 0, 0], [1, 1, 1]])
        np.testing.assert_array_equal(opened, seen.pixels(outside))
        alone = seen.pixels(outside, clip=[[0, 0, 0], [1, 1, 0.5]]).astype(np.float64)
        assert (alone == 255).mean() > (seen.pixels(outside) == 255).mean()


def test_n_and_p_step_through_the_photographs_cameras(browser: Browser, scene: Path) -> None:
    page_file = scene.with_name("b.html")
    jobs.view_file(str(scene), str(page_file), data="exact")
    with browser.opened(page_file, viewport={"width": 200, "height": 200}) as seen:
        seen.wait_until_ready()
        opened = seen.ask("nerfbake.camera.pose")
        np.testing.assert_allclose(opened, cameras().cameras[0].pose, atol=1e-6)
        for key, number in (("n", 1), ("n", 2), ("p", 1), ("p", 0), ("p", 3)):
            seen.page.keyboard.press(key)
            np.testing.assert_allclose(seen.ask("nerfbake.camera.pose"), cameras().cameras[number].pose, atol=1e-6)


def test_distances_to_the_scenery_are_measured(browser: Browser, scene: Path) -> None:
    page_file = scene.with_name("f.html")
    jobs.view_file(str(scene), str(page_file), data="exact")
    field = build_field(build_n3tree(some_shelled_field(), dtype="float32"))
    with browser.opened(page_file) as seen:
        seen.wait_until_ready()
        focal = 100 * seen.ask("nerfbake.lens.focal")
        image = render_field(field, Camera(200, 200, focal, cameras().cameras[0].pose, ""))
        far = np.argwhere((image.depth > 3) & (image.alpha > 0.5))  # the inner cube is nearer
        assert len(far) > 100
        for y, x in far[:: len(far) // 20].tolist():
            found = seen.ask("([x, y]) => nerfbake.distanceAt(x, y)", [x + 0.5, y + 0.5])
            assert found == pytest.approx(image.depth[y, x], rel=0.02)


def test_scenery_may_take_more_than_a_page_usually_has(scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("nerfbake.jobs.pages._MOST_BYTES", 1)
    target = scene.with_name("e.html")
    assert len(jobs.view_file(str(scene), str(target)).around) == 2
    assert target.exists()


def test_a_compressed_page_has_its_scenery_too(browser: Browser, scene: Path) -> None:
    page_file = scene.with_name("c.html")
    jobs.view_file(str(scene), str(page_file))
    field = build_field(build_n3tree(some_shelled_field(), dtype="float32"))
    with browser.opened(page_file) as seen:
        seen.wait_until_ready()
        camera = cameras().cameras[1]
        wanted = render_field(field, camera).pixels.astype(np.float64)
        assert decibels(seen.pixels(camera).astype(np.float64), wanted) > 30
