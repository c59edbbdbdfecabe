"""The page that draws splats, in a real browser: the same pictures as `nerfbake render`."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import Camera, Page, Splats, build_page_splats, load, orbit_cameras, render_splats, save
from tests.support.browser import Browser, Seen
from tests.support.firefox import firefox
from tests.support.splats import splats
from tests.support.viewed import decibels

pytestmark = [pytest.mark.tools, pytest.mark.slow]
EDGE = 120
ALIKE = 55  # dB; half floats give 60 to 66
LIGHT = (0xF4 / 255, 0xF5 / 255, 0xF7 / 255)
PIXELS = """(() => {{
  const camera = new nerfbake.camera.constructor({{pose: {pose}, focal: {focal}, distance: 1}}, nerfbake.facts.up, 1);
  return btoa(String.fromCharCode(...nerfbake.picture.pixels(camera, {edge}, {edge}, {{background: [1, 1, 1]}})));
}})()"""


class Drawn(NamedTuple):
    """The file of a page, and the splats that it should draw."""

    path: Path
    splats: Splats


def page_of(path: Path, scene: Splats) -> Drawn:
    content = build_page_splats(scene)
    cameras = orbit_cameras(scene, width=40, height=40)
    save(path, Page(content, None, cameras, render_splats(scene, cameras.cameras[0]), "Splats"))
    return Drawn(path, content.restored())


def thick(n: int, *, degree: int = 0, seed: int = 0, antialiased: bool = False) -> Splats:
    """Splats that are large enough to hide each other."""
    scene = splats(n, degree=degree, seed=seed, antialiased=antialiased)
    return replace(scene, scales=scene.scales * 6, opacity=np.minimum(scene.opacity * 2, 1))


@pytest.fixture(scope="module")
def some(folder: Path) -> Drawn:
    return page_of(folder / "splats.html", thick(3000, degree=1))


def wanted(scene: Splats, camera: Camera, **options: object) -> npt.NDArray[np.float64]:
    return render_splats(scene, camera, **options).pixels.astype(np.float64)  # type: ignore[arg-type]


def assert_alike(page: Seen, scene: Splats, *, frames: int = 1, least: float = ALIKE) -> None:
    for camera in orbit_cameras(scene, frames=frames, width=EDGE, height=EDGE).cameras:
        found = page.pixels(camera).astype(np.float64)
        assert found.std() > 1
        assert decibels(found, wanted(scene, camera)) >= least


@pytest.mark.parametrize("antialiased", [False, True], ids=["classic", "antialiased"])
@pytest.mark.parametrize("degree", range(5))
def test_it_shows_what_render_does(browser: Browser, folder: Path, degree: int, antialiased: bool) -> None:
    scene = thick(3000, degree=degree, antialiased=antialiased)
    made = page_of(folder / f"{degree}{antialiased}.html", scene)
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        assert_alike(page, made.splats, frames=2)
        assert page.log == []


@pytest.mark.data
def test_so_it_does_of_a_real_scene_within_a_tighter_bound(browser: Browser, folder: Path, data: Path) -> None:
    made = page_of(folder / "biker.html", load(data / "splats" / "biker.spz", Splats))
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        assert_alike(page, made.splats, frames=2, least=60)


def test_one_splat_and_what_cannot_be_seen(browser: Browser, folder: Path) -> None:
    one = thick(1, degree=3)
    made = page_of(folder / "one.html", one)
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        assert_alike(page, made.splats)
    made = page_of(folder / "none.html", replace(thick(20), opacity=np.full(20, 0.001, np.float32)))
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        page.wait_until_still()
        [camera] = orbit_cameras(made.splats, width=EDGE, height=EDGE).cameras
        assert (page.pixels(camera) == 255).all()


def test_the_largest_numbers_are_drawn_without_an_error(browser: Browser, folder: Path) -> None:
    scene = thick(200, degree=1)
    scene.sh[:50] = 1e30
    scene.sh[50:90] = -1e30
    scene.scales[:5] = [1e8, 0, 0]
    scene.scales[5:9] = 0
    scene.means[10:12] = [[1e8, 0, 0], [0, -1e7, 1e8]]
    made = page_of(folder / "hostile.html", scene)
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        page.wait_until_still()
        # Needles of this length lose their digits in 32 bits, here as there.
        [camera] = orbit_cameras(made.splats, width=EDGE, height=EDGE).cameras
        assert decibels(page.pixels(camera).astype(np.float64), wanted(made.splats, camera)) > 20
        assert page.log == []


def test_what_rests_is_in_the_order_of_its_own_view(browser: Browser, some: Drawn) -> None:
    """The page turns, its worker sorts, and the picture that it copies its camera for is that of `render`."""
    with browser.opened(some.path, viewport={"width": 150, "height": 180}) as page:
        page.wait_until_ready()
        for key in ("ArrowLeft",) * 12 + ("+", "ArrowUp"):
            page.page.keyboard.press(key)
        page.wait_until_still()
        got = page.ask("nerfbake.capture()")
        camera = Camera(got["w"], got["h"], got["fl_x"], np.array(got["frames"][0]["transform_matrix"]))
        held = base64.b64decode(page.ask("textOf(nerfbake.picture.held('fine').bytes)"))
        found = np.frombuffer(held, np.uint8).reshape(got["h"], got["w"], 4)[..., :3].astype(np.float64)
        assert decibels(found, wanted(some.splats, camera, background=LIGHT)) >= ALIKE
        assert page.log == []


def test_a_picture_drawn_in_parts_is_the_whole_one(browser: Browser, some: Drawn) -> None:
    script = """() => {
      const { picture, lens, shown } = nerfbake, [w, h] = [90, 70];
      nerfbake.state = "held";
      picture.look(lens, w, h, shown);
      picture.draw("fine", w, h);
      const whole = textOf(picture.held("fine").bytes);
      for (let to = h; to > 0; to = Math.max(0, to - 9)) {
        picture.look(lens, w, h, shown);
        picture.draw("fine", w, h, Math.max(0, to - 9), to);
        if (to === 43) picture.distanceAt(lens, 75, 90, shown); // the pointer moves meanwhile
      }
      return [whole, textOf(picture.held("fine").bytes)];
    }"""
    with browser.opened(some.path, viewport={"width": 150, "height": 180}) as page:
        page.wait_until_ready()
        page.wait_until_still()
        whole, parts = (np.frombuffer(base64.b64decode(text), np.uint8).astype(int) for text in page.ask(script))
        assert whole.std() > 1
        assert np.abs(whole - parts).max() <= 1  # pixels are closed after other splats


def test_a_coarse_picture_is_nearly_the_fine_one(browser: Browser, some: Drawn) -> None:
    [camera] = orbit_cameras(some.splats, width=EDGE, height=EDGE).cameras
    fine = wanted(some.splats, camera)
    with browser.opened(some.path) as page:
        page.wait_until_ready()
        for scale, least in ((0.5, 28), (0.4, 17)):  # from 0.5 all splats are drawn
            edge = int(EDGE * scale)
            mean = (
                fine.reshape(edge, EDGE // edge, edge, EDGE // edge, 3).mean(axis=(1, 3)) if EDGE % edge == 0 else None
            )
            found = page.pixels(camera.resized(edge, edge), scale=scale).astype(np.float64)
            truth = mean if mean is not None else wanted(some.splats, camera.resized(edge, edge))
            assert decibels(found, truth) > least


def test_the_crop_box_hides_centres_outside_of_it(browser: Browser, some: Drawn) -> None:
    [camera] = orbit_cameras(some.splats, width=EDGE, height=EDGE).cameras
    with browser.opened(some.path) as page:
        page.wait_until_ready()
        place = np.array(page.ask("nerfbake.facts.place"))
        up = some.splats.means.astype(np.float64) @ place[2, :3] + place[2, 3]
        kept = up <= 0.5
        arrays = (some.splats.means, some.splats.scales, some.splats.quats, some.splats.opacity, some.splats.sh)
        lower = Splats(*(array[kept] for array in arrays))
        found = page.pixels(camera, clip=[[0, 0, 0], [1, 1, 0.5]]).astype(np.float64)
        assert decibels(found, wanted(lower, camera)) >= ALIKE
        assert page.page.is_hidden("#lookup")
        page.page.keyboard.press("o")
        assert page.page.is_visible("#clip")


def test_depth_and_first_coefficients(browser: Browser, some: Drawn) -> None:
    with browser.opened(some.path, viewport={"width": 160, "height": 160}) as page:
        page.wait_until_ready()
        page.page.keyboard.press("o")
        page.wait_until_still()
        got = page.ask("nerfbake.capture()")
        camera = Camera(got["w"], got["h"], got["fl_x"], np.array(got["frames"][0]["transform_matrix"]))
        depth = render_splats(some.splats, camera)
        y, x = np.unravel_index(depth.alpha.argmax(), depth.alpha.shape)
        assert page.ask(f"nerfbake.distanceAt({x + 0.5}, {y + 0.5})") == pytest.approx(depth.depth[y, x], rel=0.005)
        [square] = orbit_cameras(some.splats, width=EDGE, height=EDGE).cameras
        first = wanted(some.splats.with_degree(0), square)
        assert decibels(page.pixels(square, mode="first").astype(np.float64), first) >= ALIKE
        found = page.pixels(square, mode="depth").astype(np.float64)
        truth, centre = render_splats(some.splats, square), np.array(page.ask("nerfbake.facts.centre"))
        away, radius = np.linalg.norm(square.pose[:3, 3] - centre), page.ask("nerfbake.facts.radius")
        shade = 1 - 0.85 * ((truth.depth - away + radius) / (2 * radius)).clip(0, 1)
        expected = 255 * (1 + truth.alpha * (shade - 1))
        assert decibels(found[..., 0], expected) >= 45


def test_the_help_names_the_keys_that_splats_have(browser: Browser, some: Drawn) -> None:
    with browser.opened(some.path) as page:
        page.wait_until_ready()
        page.page.keyboard.press("h")
        told = page.page.inner_text("#help")
        assert "1 to 3 what is shown" in told
        assert "crop box, distances" in told
        assert "voxel" not in told
        page.page.keyboard.press("Escape")
        for key, mode in (("2", "first"), ("3", "depth"), ("4", "depth"), ("1", "colour")):
            page.page.keyboard.press(key)
            assert page.ask("nerfbake.looks.mode") == mode
        assert page.log == []


def test_graphics_that_are_lost_come_back(browser: Browser, some: Drawn) -> None:
    with browser.opened(some.path) as page:
        page.wait_until_ready()
        page.ask("window.lose = nerfbake.picture.gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
        page.wait_for("nerfbake.state === 'lost'")
        page.page.keyboard.press("ArrowLeft")
        page.ask("lose.restoreContext()")
        page.wait_until_ready()
        page.wait_until_still()
        assert_alike(page, some.splats)


@pytest.mark.parametrize("name", ["EXT_color_buffer_float", "WebGL"])
def test_without_what_it_needs_there_is_a_sentence(browser: Browser, some: Drawn, name: str) -> None:
    without = {
        "EXT_color_buffer_float": "WebGL2RenderingContext.prototype.getExtension = () => null",
        "WebGL": "HTMLCanvasElement.prototype.getContext = () => null",
    }
    said = {"EXT_color_buffer_float": "cannot blend half floats", "WebGL": "needs WebGL 2"}
    with browser.opened(some.path, init=without[name]) as page:
        page.wait_for("nerfbake.state === 'failed'")
        assert said[name] in page.status
        assert "still picture" in page.status


def test_a_worker_that_cannot_run_leaves_a_sentence(browser: Browser, some: Drawn) -> None:
    with browser.opened(
        some.path, init="window.Worker = class { constructor() { throw new Error('no worker'); } }"
    ) as page:
        page.wait_for("nerfbake.state === 'failed'")
        assert "no worker" in page.status


def test_firefox_shows_the_same(some: Drawn, tmp_path: Path) -> None:
    [camera] = orbit_cameras(some.splats, width=100, height=100).cameras
    with firefox(tmp_path) as browser:
        browser.open(some.path)
        browser.wait_for("['ready', 'failed'].includes(window.nerfbake?.state)")
        assert browser.ask("nerfbake.state") == "ready"
        text = browser.ask(PIXELS.format(pose=camera.pose.tolist(), focal=2 * camera.fx / 100, edge=100))
        browser.wait_for("nerfbake.finished")
        assert browser.log == []
    found = np.frombuffer(base64.b64decode(text), np.uint8).reshape(100, 100, 4)[..., :3].astype(np.float64)
    assert decibels(found, wanted(some.splats, camera)) >= ALIKE
