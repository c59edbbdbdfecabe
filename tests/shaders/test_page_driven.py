"""What people do with a page in a real browser: pointers, fingers, keys, windows, options."""

from __future__ import annotations

import base64
import json
from pathlib import Path

import numpy as np
import pytest

from nerfbake import Camera, Cameras, Image, build_field, load, render_field, sample_n3tree
from tests.support.browser import Browser, Seen
from tests.support.viewed import EDGE, Made, assert_same_pictures, decibels, exact_page

pytestmark = [pytest.mark.tools, pytest.mark.slow]
LIGHT = (0xF4 / 255, 0xF5 / 255, 0xF7 / 255)  # the page's own background


def test_a_page_is_silent_and_draws_nothing_while_nothing_changes(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.wait_until_still()
        drawn = page.ask("nerfbake.frames")
        page.page.wait_for_timeout(700)
        assert page.ask("nerfbake.frames") == drawn
        assert page.log == []
        assert page.ask("nerfbake.carried.text") is None
        assert page.ask("document.getElementById('data')") is None
        # What stands on the screen at rest is refined: the mean of four rays a pixel, and not empty.
        assert page.page.is_hidden("#note")


def test_keys_pointers_and_the_address_move_the_camera(browser: Browser, exact: Made) -> None:
    # Wide enough for the buttons to leave the middle free.
    with browser.opened(exact.path, viewport={"width": 400, "height": 300}) as page:
        page.wait_until_ready()
        opened = page.ask("nerfbake.camera.pose")
        assert page.ask("location.hash") == ""
        for act in (
            lambda: page.page.keyboard.press("ArrowLeft"),
            lambda: page.page.keyboard.press("Shift+ArrowUp"),
            lambda: page.page.keyboard.press("+"),
            lambda: page.page.mouse.wheel(0, 200),
            lambda: drag(page, "left"),
            lambda: drag(page, "right"),
            lambda: page.page.keyboard.press("r"),
            lambda: page.page.mouse.dblclick(200, 125),
        ):
            before = page.ask("JSON.stringify(nerfbake.camera.pose)")
            act()
            page.wait_for(f"JSON.stringify(nerfbake.camera.pose) !== {json.dumps(before)}")
        moved, drawn = page.ask("nerfbake.camera.pose"), page.ask("nerfbake.capture()")
        assert drawn["frames"][0]["transform_matrix"] == moved
        page.wait_for("location.hash === nerfbake.camera.hash")
        address = page.ask("location.hash")
        page.page.keyboard.press("r")
        assert page.ask("nerfbake.camera.pose") == opened
        assert page.log == []
    with browser.opened(exact.path, hash=address) as page:
        page.wait_until_ready()
        np.testing.assert_allclose(page.ask("nerfbake.camera.pose"), moved, atol=1e-7)


def drag(page: Seen, button: str) -> None:
    mouse = page.page.mouse
    mouse.move(200, 120)
    mouse.down(button=button)
    mouse.move(240, 130)
    mouse.up(button=button)


def test_the_copied_camera_renders_the_same_picture(browser: Browser, exact: Made, tmp_path: Path) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.page.keyboard.press("ArrowUp")
        (tmp_path / "c.json").write_text(json.dumps(page.ask("nerfbake.capture()")))
        [camera] = load(tmp_path / "c.json", Cameras).cameras
        assert (camera.width, camera.height) == (EDGE, EDGE)
        wanted = render_field(exact.field, camera).pixels.astype(np.float64)
        text = page.ask("textOf(nerfbake.picture.pixels(nerfbake.lens, 200, 200, {background: [1, 1, 1]}))")
        shown = np.frombuffer(base64.b64decode(text), np.uint8).reshape(EDGE, EDGE, 4)[..., :3]
        assert ((shown - wanted) ** 2).mean() / 255**2 <= 10**-8.0
        pose = page.ask("nerfbake.camera.pose")
        np.testing.assert_allclose(camera.pose, pose, atol=1e-12)


def test_a_scene_turns_until_it_is_touched(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, reduced_motion="no-preference", viewport={"width": 40, "height": 40}) as page:
        page.wait_until_ready()
        assert page.ask("nerfbake.facts.turns")
        page.wait_for("nerfbake.angle > 0")
        page.page.keyboard.press("ArrowLeft")
        assert not page.ask("nerfbake.turning")


def test_graphics_that_are_lost_come_back(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.ask("window.lose = nerfbake.picture.gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
        page.wait_for("nerfbake.state === 'lost'")
        assert "taken away" in page.status
        page.ask("lose.restoreContext()")
        page.wait_until_ready()
        assert_same_pictures(page, exact.field)


def test_a_phone_shows_every_button_in_dark_colours(browser: Browser, exact: Made) -> None:
    size = {"width": 320, "height": 480}
    with browser.opened(exact.path, viewport=size, color_scheme="dark", has_touch=True) as page:
        page.wait_until_ready()
        for button in page.page.query_selector_all("#tools :is(button, select):not([hidden])"):
            box = button.bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= 320
            assert min(box["width"], box["height"]) >= 43.9
        assert page.ask("getComputedStyle(document.body).backgroundColor") == "rgb(21, 24, 28)"
        assert page.page.get_attribute("#canvas", "aria-label").startswith("A sample: ")


def test_two_fingers_zoom_and_move(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, has_touch=True, viewport={"width": 400, "height": 300}) as page:
        page.wait_until_ready()
        distance, pivot = page.ask("nerfbake.camera.distance"), np.array(page.ask("nerfbake.camera.pivot"))
        touch(page, [[(80, 90), (120, 90)], [(60, 90), (140, 90)]])
        page.wait_for(f"Math.abs(nerfbake.camera.distance / {distance} - 0.5) < 0.01")
        np.testing.assert_allclose(page.ask("nerfbake.camera.pivot"), pivot, atol=0.01 * distance)
        page.ask("window.before = nerfbake.camera.pivot")
        touch(page, [[(60, 90), (140, 90)], [(60, 110), (140, 110)]])
        page.wait_for(f"Math.hypot(...nerfbake.camera.pivot.map((at, i) => at - before[i])) > {0.01 * distance}")
        assert page.ask("nerfbake.camera.distance") == pytest.approx(distance / 2, rel=0.05)
        # One finger turns: another position, the same pivot.
        pivot = page.ask("window.before = nerfbake.camera.position, nerfbake.camera.pivot")
        touch(page, [[(60, 90)], [(90, 90)]])
        page.wait_for(f"Math.hypot(...nerfbake.camera.position.map((at, i) => at - before[i])) > {0.01 * distance}")
        np.testing.assert_allclose(page.ask("nerfbake.camera.pivot"), pivot, atol=1e-6)
        assert page.log == []


def touch(page: Seen, places: list[list[tuple[int, int]]]) -> None:
    """Fingers that go down at the first places, on to each of the others, and up."""
    session = page.page.context.new_cdp_session(page.page)
    for i, fingers in enumerate(places):
        points = [{"x": x, "y": y, "id": number} for number, (x, y) in enumerate(fingers)]
        session.send("Input.dispatchTouchEvent", {"type": "touchMove" if i else "touchStart", "touchPoints": points})
    session.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})


def test_a_window_of_another_size_and_a_screen_of_more_pixels(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, device_scale_factor=2, viewport={"width": 120, "height": 100}) as page:
        page.wait_until_ready()
        page.wait_until_still()
        assert page.ask("[nerfbake.canvas.width, nerfbake.canvas.height]") == [240, 200]
        page.page.set_viewport_size({"width": 100, "height": 140})
        page.wait_for("nerfbake.canvas.width === 200 && nerfbake.canvas.height === 280")
        page.wait_until_still()
        # The copied camera is as large as what is seen, and in its middle.
        capture = page.ask("nerfbake.capture()")
        assert (capture["w"], capture["h"], capture["cx"], capture["cy"]) == (200, 280, 100, 140)
        assert page.log == []


def test_a_still_reader_gets_a_still_page(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, reduced_motion="reduce") as page:
        page.wait_until_ready()
        page.wait_until_still()
        assert page.ask("nerfbake.facts.turns")
        assert page.ask("nerfbake.angle") == 0
        assert page.ask("getComputedStyle(document.getElementById('cover')).transitionDuration") == "0s"


def test_what_was_unpacked_is_given_back(browser: Browser, folder: Path) -> None:
    """Behind unpacking, the page holds its packed bytes and no array beside them."""
    exact = exact_page(folder / "large.html", build_field(sample_n3tree(resolution=64)))
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.wait_until_still()
        held = page.ask("nerfbake.carried.packed.length")
        session = page.page.context.new_cdp_session(page.page)
        session.send("HeapProfiler.collectGarbage")
        buffers = session.send("Runtime.getHeapUsage")["backingStorageSize"]
        unpacked = exact.arrays.texels.nbytes
        assert held < unpacked / 2
        assert buffers < held + unpacked / 2


def test_the_panel_is_closed_and_changes_what_is_seen(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, viewport={"width": 420, "height": 640}) as page:
        page.wait_until_ready()
        assert page.page.is_hidden("#panel")
        page.page.keyboard.press("o")
        assert page.page.is_visible("#panel")
        assert page.page.get_attribute("#options", "aria-expanded") == "true"
        page.page.select_option("#lookup", "trilinear")
        assert page.ask("nerfbake.shown.smoothly")
        page.page.focus("#cut")
        before = page.ask("JSON.stringify(nerfbake.camera.pose)")
        page.page.keyboard.press("End")
        page.page.keyboard.press("ArrowLeft")
        assert page.ask("JSON.stringify(nerfbake.camera.pose)") == before  # the arrows are the slider's
        assert 0.5 < page.ask("nerfbake.shown.cut") < 0.9
        assert page.page.inner_text("#cut_told") == f"{page.ask('nerfbake.shown.cut'):.2f}"
        low, high = page.page.locator("#clip input").all()[4:]
        low.fill("0.6")
        assert page.ask("nerfbake.shown.clip") == [[0, 0, 0.6], [1, 1, 1]]
        high.fill("0.3")
        assert page.ask("nerfbake.shown.clip") == [[0, 0, pytest.approx(0.28)], [1, 1, 0.3]]
        page.page.click("#whole")
        assert page.ask("nerfbake.shown.clip") == [[0, 0, 0], [1, 1, 1]]
        page.page.select_option("#detail", "2")
        page.wait_for("nerfbake.picture.facts.shape.join() === '1,1,1'")
        page.wait_until_still()
        page.page.keyboard.press("o")
        assert page.page.is_hidden("#panel")
        assert page.log == []


def test_the_depth_under_the_pointer_is_what_render_says(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, viewport={"width": 800, "height": 240}) as page:
        page.wait_until_ready()
        page.page.keyboard.press("o")
        page.page.mouse.move(400, 120)
        page.wait_for("document.getElementById('depth').textContent.length > 1")
        told = float(page.page.inner_text("#depth"))
        camera = camera_of(page)
        depth = render_field(exact.field, camera).depth[120, 400]
        assert told == pytest.approx(depth, rel=0.01)
        page.page.mouse.move(60, 60)
        page.wait_for("document.getElementById('depth').textContent.length === 1")


def camera_of(page: Seen) -> Camera:
    found = page.ask("nerfbake.capture()")
    return Camera(found["w"], found["h"], found["fl_x"], np.array(found["frames"][0]["transform_matrix"]))


def test_the_saved_picture_is_what_is_seen(browser: Browser, exact: Made, tmp_path: Path) -> None:
    with browser.opened(exact.path, accept_downloads=True) as page:
        page.wait_until_ready()
        with page.page.expect_download() as found:
            page.page.keyboard.press("s")
        found.value.save_as(tmp_path / "saved.png")
        assert found.value.suggested_filename == "A_sample.png"
        saved = load(tmp_path / "saved.png", Image).pixels[..., :3].astype(np.float64)
        wanted = render_field(exact.field, camera_of(page), background=LIGHT, samples=2).pixels
        assert decibels(saved, wanted.astype(np.float64)) > 55
        assert page.log == []


def test_frames_are_told_while_the_view_moves_and_only_then(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.page.keyboard.press("o")
        page.page.keyboard.press("t")
        page.wait_until_still()
        assert page.page.text_content("#pace") == "\u2013"
        page.page.keyboard.press("ArrowLeft")
        page.wait_for("/^\\d+ ms, [\\d.]+ a second$/.test(document.getElementById('pace').textContent)")
