"""Photographs that a page shows over its scene, in a real browser."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image as Pillow

from nerfbake import Cameras, build_field, jobs, orbit_cameras, render_field, sample_n3tree, save
from tests.support.browser import Browser, Seen
from tests.support.viewed import decibels

pytestmark = [pytest.mark.tools, pytest.mark.slow]
WIDTH, HEIGHT = 240, 160
WINDOW = {"width": 420, "height": 364}


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The page of a scene and of three photographs of it, whose pixels are not square and not centred."""
    folder = tmp_path_factory.mktemp("photographs")
    tree = sample_n3tree(resolution=32)
    field = build_field(tree)
    orbit = orbit_cameras(field, frames=3, width=WIDTH, height=HEIGHT)
    cameras = [
        replace(
            camera,
            focal=(camera.fx, 0.85 * camera.fx),
            centre=(0.46 * WIDTH, 0.56 * HEIGHT),
            name=str(i),
        )
        for i, camera in enumerate(orbit.cameras)
    ]
    save(folder / "a.npz", tree)
    (folder / "capture").mkdir()
    for camera in cameras:
        picture = Pillow.fromarray(render_field(field, camera, samples=2).pixels)
        picture.save(folder / "capture" / f"{camera.name}.png")
    save(folder / "capture" / "transforms.json", Cameras(tuple(cameras)))
    page = folder / "a.html"
    jobs.view_file(
        str(folder / "a.npz"),
        str(page),
        cameras=str(folder / "capture"),
        data="exact",
        photographs=True,
        background=(1.0, 1.0, 1.0),
    )
    return page


def seen_pixels(seen: Seen) -> npt.NDArray[np.float64]:
    """The screen between the title and the buttons."""
    seen.wait_until_still()
    shot = Pillow.open(io.BytesIO(seen.page.screenshot())).convert("RGB")
    return np.asarray(shot, np.float64)[60:290]


def test_a_photograph_lies_exactly_over_the_scene(browser: Browser, page_file: Path) -> None:
    with browser.opened(page_file, viewport=WINDOW) as seen:
        seen.wait_until_ready()
        for _ in range(3):
            scene = seen_pixels(seen)
            seen.page.keyboard.press("v")
            box: Any = seen.page.query_selector("#photograph").bounding_box()
            photograph = seen_pixels(seen)
            rows, columns = (
                slice(max(0, int(low) + 1), int(low + edge))
                for low, edge in ((box["y"] - 60, box["height"]), (box["x"], box["width"]))
            )
            apart = decibels(scene[rows, columns], photograph[rows, columns])
            moved = decibels(scene[rows, columns][:, 4:], photograph[rows, columns][:, :-4])
            assert apart > 25
            assert apart > moved + 3  # four pixels to a side are seen
            assert not (scene == photograph).all()
            seen.page.keyboard.press("v")
            seen.page.keyboard.press("n")
        assert seen.log == []


def test_the_photograph_follows_n_and_p_and_goes_when_the_view_moves(browser: Browser, page_file: Path) -> None:
    with browser.opened(page_file, viewport=WINDOW) as seen:
        seen.wait_until_ready()
        assert seen.page.is_hidden("#photograph")
        seen.page.click("#compare")
        assert seen.page.is_visible("#photograph")
        assert seen.page.get_attribute("#compare", "aria-pressed") == "true"
        first = seen.page.get_attribute("#photograph", "src")
        seen.page.keyboard.press("n")
        assert seen.page.is_visible("#photograph")
        assert seen.page.get_attribute("#photograph", "src") != first
        seen.page.keyboard.press("ArrowLeft")
        assert seen.page.is_hidden("#photograph")
        assert seen.page.get_attribute("#compare", "aria-pressed") == "false"
        # The photograph's own camera comes back with the photograph.
        seen.page.keyboard.press("v")
        assert seen.page.is_visible("#photograph")
        np.testing.assert_allclose(
            seen.ask("nerfbake.camera.pose"), seen.ask("nerfbake.facts.views[1].pose"), atol=1e-9
        )
        seen.page.set_viewport_size({"width": 300, "height": 400})
        seen.wait_until_still()
        box: Any = seen.page.query_selector("#photograph").bounding_box()
        # The shorter edge of the photograph spans that of the window, as the scene does.
        assert box["width"] == pytest.approx(300 * WIDTH / HEIGHT, abs=1)


def test_a_page_without_photographs_has_no_button_for_them(browser: Browser, page_file: Path) -> None:
    other = page_file.with_name("b.html")
    jobs.view_file(
        str(page_file.with_suffix(".npz")), str(other), data="exact", cameras=str(page_file.with_name("capture"))
    )
    with browser.opened(other, viewport=WINDOW) as seen:
        seen.wait_until_ready()
        assert seen.page.is_hidden("#compare")
        seen.page.keyboard.press("v")
        assert seen.page.is_hidden("#photograph")
        assert seen.log == []
