"""Nothing is black that is not the scene: while the page unpacks, when it is broken, and when its window changes."""

from __future__ import annotations

import io
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from PIL import Image as Pillow

from tests.support.browser import Browser, Seen
from tests.support.viewed import Made

pytestmark = [pytest.mark.tools, pytest.mark.slow]
PHONE, DESKTOP = ({"width": w, "height": h} for w, h in ((390, 844), (1440, 900)))
# The same shapes, smaller: software draws four rays for each of four pixels.
UPRIGHT, LYING, WIDE, NARROW = ({"width": w, "height": h} for w, h in ((150, 325), (325, 150), (320, 200), (160, 200)))
PAPER = {"light": (0xF4, 0xF5, 0xF7), "dark": (0x15, 0x18, 0x1C)}
# Halts the last pass over a picture after two of its bands, as if the graphics took long.
HALT = """(() => {
  const { prototype } = nerfbake.constructor, fine = prototype.drawFine;
  let bands = 0;
  nerfbake.drawFine = function (now) {
    this.lines = 32;
    if (this.rest.rays === 2 && ++bands > 2) return void (window.halted = true);
    return fine.call(this, now);
  };
  window.resume = () => { delete nerfbake.drawFine; nerfbake.lines = 4096; nerfbake.ask(); };
})()"""


def screenshot(page: Seen) -> npt.NDArray[np.int16]:
    """(H, W, 3) what the window shows, without the page's buttons and words."""
    page.page.evaluate("for (const id of ['tools', 'panel', 'note']) document.getElementById(id).style.opacity = 0")
    page.page.evaluate("document.querySelector('h1').style.opacity = 0")
    pixels = np.asarray(Pillow.open(io.BytesIO(page.page.screenshot())).convert("RGB")).astype(np.int16)
    page.page.evaluate("for (const id of ['tools', 'panel', 'note']) document.getElementById(id).style.opacity = ''")
    return pixels


def black(pixels: npt.NDArray[np.int16]) -> float:
    return float((pixels.max(axis=2) == 0).mean())


def near(pixels: npt.NDArray[np.int16], colour: tuple[int, int, int]) -> float:
    return float((np.abs(pixels - np.array(colour)).max(axis=2) <= 2).mean())


CHANGES: dict[str, tuple[dict[str, int], Callable[[Any], None]]] = {
    "rotated": (LYING, lambda page: page.set_viewport_size(UPRIGHT)),
    "narrower": (WIDE, lambda page: page.set_viewport_size(NARROW)),
    "wider": (NARROW, lambda page: page.set_viewport_size(WIDE)),
    "panel opened": (UPRIGHT, lambda page: page.keyboard.press("o")),
    "background": (UPRIGHT, lambda page: page.keyboard.press("b")),
}


@pytest.mark.parametrize("name", CHANGES)
def test_a_change_in_the_middle_of_a_picture_leaves_nothing_of_it(browser: Browser, exact: Made, name: str) -> None:
    size, change = CHANGES[name]
    with browser.opened(exact.path, device_scale_factor=2, viewport=size) as page:
        page.wait_until_ready()
        page.ask(HALT)
        page.wait_for("window.halted")
        before = page.ask("[nerfbake.canvas.clientWidth, nerfbake.canvas.clientHeight, nerfbake.frames]")
        change(page.page)
        page.wait_for(
            "JSON.stringify([nerfbake.canvas.clientWidth, nerfbake.canvas.clientHeight, nerfbake.frames]) !== "
            f"'{before}'.replaceAll(' ', '')"
        )
        page.ask("resume()")
        page.wait_until_still()
        found = screenshot(page)
        page.ask("nerfbake.change()")
        page.wait_until_still()
        assert black(found) == 0
        assert np.abs(found - screenshot(page)).max() <= 8  # the same picture as one that nothing disturbed


def test_a_panel_that_is_closed_leaves_no_black(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, device_scale_factor=2, viewport=UPRIGHT) as page:
        page.wait_until_ready()
        page.page.keyboard.press("o")
        page.wait_until_still()
        page.ask("nerfbake.change()")
        page.ask(HALT)
        page.wait_for("window.halted")
        page.page.keyboard.press("o")
        page.wait_for("nerfbake.canvas.clientHeight === 325")
        page.ask("resume()")
        page.wait_until_still()
        assert black(screenshot(page)) == 0


@pytest.mark.parametrize("scheme", PAPER)
@pytest.mark.parametrize("size", [PHONE, DESKTOP], ids=["phone", "desktop"])
def test_the_still_picture_stands_on_the_pages_own_background_until_the_scene_is_drawn(
    browser: Browser, exact: Made, scheme: str, size: dict[str, int]
) -> None:
    # The page stops where it would unpack its data.
    hold = "const slow = setTimeout; window.setTimeout = (act, ...more) => window.held ? 0 : slow(act, ...more);"
    with browser.opened(exact.path, viewport=size, color_scheme=scheme, init=f"window.held = true; {hold}") as page:
        page.wait_for("window.nerfbake?.picture")
        page.page.wait_for_timeout(300)
        assert page.ask("nerfbake.state") == "unpacking"
        found = screenshot(page)
        assert black(found) == 0
        assert 0.3 < near(found, PAPER[scheme]) < 0.999
        middle = found[size["height"] // 2, size["width"] // 2 - 60 : size["width"] // 2 + 60]
        assert near(middle[None], PAPER[scheme]) < 0.9  # the cover is there


@pytest.mark.parametrize("scheme", PAPER)
def test_a_broken_page_shows_its_still_picture(browser: Browser, exact: Made, tmp_path: Path, scheme: str) -> None:
    text = exact.path.read_text()
    start = text.index('id="data">') + 2000
    (tmp_path / "broken.html").write_text(text[:start] + "AAAA" * 200 + text[start + 800 :])
    with browser.opened(tmp_path / "broken.html", viewport=PHONE, color_scheme=scheme) as page:
        page.wait_for("window.nerfbake?.state === 'failed'")
        assert "cannot be shown" in page.status
        found = screenshot(page)
        assert black(found) == 0
        assert 0.3 < near(found, PAPER[scheme]) < 0.999


def test_the_still_picture_comes_back_while_the_graphics_are_lost(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, viewport=UPRIGHT) as page:
        page.wait_until_ready()
        page.wait_for("document.getElementById('cover').classList.contains('gone')")
        page.ask("window.lose = nerfbake.picture.gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
        page.wait_for("nerfbake.state === 'lost'")
        assert black(screenshot(page)) == 0
        page.ask("lose.restoreContext()")
        page.wait_until_ready()
        page.wait_until_still()
        assert page.ask("nerfbake.canvas.classList.contains('drawn')")


def test_every_control_says_what_it_does(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        named = page.ask("""[...document.querySelectorAll("button, select, input, #panel dl > div")]
          .filter((each) => !each.closest("dialog"))
          .map((each) => [each.outerHTML, each.closest("[title]")?.title ?? ""])""")
        assert len(named) > 15
        assert [html for html, title in named if len(title.split()) < 2 and "Options" not in title] == []
