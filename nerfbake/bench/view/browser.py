"""A headless Chromium that draws pages, and the processor's time that its graphics take.

Playwright drives it: the one that is installed as `chromium`, or else Playwright's own.
"""

from __future__ import annotations

import base64
import os
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nerfbake.bench.extras import require_installed
from nerfbake.errors import NerfbakeError, one_line
from nerfbake.scene.camera import Camera

SWIFTSHADER = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
LLVMPIPE = ("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist")
OWN = ("--enable-unsafe-swiftshader",)  # what the browser chooses by itself, software where there is nothing else
PATIENCE = 300  # seconds until a page has drawn itself, in software and on a busy machine
_POLL = 0.05
_FAILED = "window.nerfbake?.state === 'failed'"
_STILL = "nerfbake.finished && !nerfbake.asked && !nerfbake.busy"
_STATUS = "document.getElementById('status').textContent"
_RENDERER = """() => {
  const gl = nerfbake.picture.gl, more = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(more ? more.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}"""
# Draws from every camera, and tells what graphics say of it; the pictures themselves as text where they are wanted.
_DRAW = """([views, edge, wanted, looks]) => {
  const { facts, camera, picture } = nerfbake;
  const found = views.map(([pose, focal]) => {
    const from = new camera.constructor({ pose, focal, distance: 1 }, facts.up, facts.radius);
    return picture.pixels(from, edge, edge, { background: [1, 1, 1], ...looks });
  });
  const error = picture.gl.getError();
  if (error) throw new Error("WebGL error " + error);
  if (!wanted) return [];
  return found.map((bytes) => {
    let text = "";
    for (let i = 0; i < bytes.length; i += 4096) text += String.fromCharCode(...bytes.subarray(i, i + 4096));
    return btoa(text);
  });
}"""


class Tab:
    """A page that is open."""

    def __init__(self, page: Any) -> None:
        self._page = page

    @property
    def renderer(self) -> str:
        """What draws, as WebGL tells it."""
        return str(self._page.evaluate(_RENDERER))

    def draw(self, cameras: Sequence[Camera], edge: int, **looks: Any) -> None:
        """A square picture from each camera, finished; looks: as the page's picture.pixels() has them."""
        self._page.evaluate(_DRAW, [_views(cameras), edge, False, looks])

    def pictures(self, cameras: Sequence[Camera], edge: int, **looks: Any) -> list[npt.NDArray[np.uint8]]:
        """The same, each (edge, edge, 3)."""
        found = self._page.evaluate(_DRAW, [_views(cameras), edge, True, looks])
        return [np.frombuffer(base64.b64decode(text), np.uint8).reshape(edge, edge, 4)[..., :3] for text in found]

    def ask(self, script: str) -> Any:
        """What a script finds in the page."""
        return self._page.evaluate(script)

    def wait_for(self, script: str) -> None:
        """Until the script says so, asked from outside: the page's policy forbids what Playwright would do."""
        for _ in range(round(PATIENCE / _POLL)):
            if self.ask(script):
                return
            time.sleep(_POLL)
        raise NerfbakeError(f"a page was not there after {PATIENCE} s: {self.ask(_STATUS)}")


class Chromium:
    """One browser for many pages."""

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium
        self._session = chromium.new_browser_cdp_session()

    @contextmanager
    def opened(self, path: Path, *, edge: int = 64, until: str = _STILL) -> Iterator[Tab]:
        """The page in a window of edge x edge pixels, once a script says so: by default when it draws no more by
        itself. Raises NerfbakeError with the page's own words where it shows nothing."""
        viewport = {"width": edge, "height": edge}
        context = self._chromium.new_context(viewport=viewport, reduced_motion="reduce")
        try:
            page = context.new_page()
            page.goto(path.resolve().as_uri(), wait_until="commit")
            tab = Tab(page)
            tab.wait_for(f"{_FAILED} || (window.nerfbake && ({until}))")
            if tab.ask(_FAILED):
                raise NerfbakeError(tab.ask(_STATUS))
            yield tab
        finally:
            context.close()

    def graphics_seconds(self) -> float:
        """The processor's time that the browser's graphics have taken so far, on all cores."""
        found = self._session.send("SystemInfo.getProcessInfo")["processInfo"]
        return float(sum(process["cpuTime"] for process in found if process["type"] == "GPU"))


def require_browser() -> None:
    """Raises UsageError, before anything is measured, without what drives a browser."""
    require_installed("playwright", "timing pages")


@contextmanager
def chromium(flags: Sequence[str] = OWN) -> Iterator[Chromium]:
    """The browser. Raises UsageError without Playwright, NerfbakeError where no browser can be started."""
    require_browser()
    from playwright.sync_api import Error, sync_playwright

    sandbox = ["--no-sandbox"] * (os.geteuid() == 0)
    with sync_playwright() as driver:
        try:
            browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=[*sandbox, *flags])
        except Error as error:
            allowed = "a `chromium` on the PATH, or `playwright install chromium`"
            raise NerfbakeError(f"Chromium cannot be started: {one_line(error.message)}; allowed: {allowed}") from None
        try:
            yield Chromium(browser)
        except Error as error:
            raise NerfbakeError(f"in the browser: {one_line(error.message)}") from None
        finally:
            browser.close()


def _views(cameras: Sequence[Camera]) -> list[tuple[Any, float]]:
    """What the page's own camera needs of each: its pose, and its focal length in halves of its shorter edge."""
    return [(camera.pose.tolist(), 2 * camera.fx / min(camera.width, camera.height)) for camera in cameras]
