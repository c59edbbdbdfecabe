"""Measure frame times of pages in a headless Chromium.

Playwright controls the installed `chromium`, or its own Chromium if there is none. All pages are open in one browser.
In each round every page draws a picture from each camera; each round begins with another page. A first round does not
count. The measurement is the CPU time of the browser's GPU process: without a graphics card, this is the whole work of
a frame, and other programs do not add to it.
"""

from __future__ import annotations

import base64
import os
import shutil
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from nerfbake.bench.measure import Progress, Statistics, seconds_of
from nerfbake.errors import NerfbakeError, one_line
from nerfbake.scene.camera import Camera

SWIFTSHADER = ("--use-angle=swiftshader", "--enable-unsafe-swiftshader")
LLVMPIPE = ("--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist")
OWN = ("--enable-unsafe-swiftshader",)  # the browser's default renderer; software if there is no other
PATIENCE = 300  # seconds: limit until a page has drawn itself, in software on a busy machine
_POLL = 0.05
_FAILED = "window.nerfbake?.state === 'failed'"
_STILL = "nerfbake.finished && !nerfbake.asked && !nerfbake.busy"
_STATUS = "document.getElementById('status').textContent"
_RENDERER = """() => {
  const gl = nerfbake.picture.gl, more = gl.getExtension("WEBGL_debug_renderer_info");
  return gl.getParameter(more ? more.UNMASKED_RENDERER_WEBGL : gl.RENDERER);
}"""
# Draws from every camera, checks for WebGL errors, and returns the pictures as text if they are wanted.
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
    """An open page."""

    def __init__(self, page: Any) -> None:
        self._page = page

    @property
    def renderer(self) -> str:
        """The name of the renderer, from WebGL."""
        return str(self._page.evaluate(_RENDERER))

    def draw(self, cameras: Sequence[Camera], edge: int, **looks: Any) -> None:
        """Draw a square picture from each camera and wait for it; looks: options of the page's picture.pixels()."""
        self._page.evaluate(_DRAW, [_views(cameras), edge, False, looks])

    def pictures(self, cameras: Sequence[Camera], edge: int, **looks: Any) -> list[npt.NDArray[np.uint8]]:
        """Draw a square picture from each camera, and return the pictures, each (edge, edge, 3)."""
        found = self._page.evaluate(_DRAW, [_views(cameras), edge, True, looks])
        return [np.frombuffer(base64.b64decode(text), np.uint8).reshape(edge, edge, 4)[..., :3] for text in found]

    def ask(self, script: str) -> Any:
        """Return the value of a script in the page."""
        return self._page.evaluate(script)

    def wait_for(self, script: str) -> None:
        """Wait until the script returns true. It is polled: the page's policy forbids Playwright's own method."""
        for _ in range(round(PATIENCE / _POLL)):
            if self.ask(script):
                return
            time.sleep(_POLL)
        raise NerfbakeError(f"a page was not ready after {PATIENCE} s: {self.ask(_STATUS)}")


class Chromium:
    """One browser for many pages."""

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium
        self._session = chromium.new_browser_cdp_session()

    @contextmanager
    def opened(self, path: Path, *, edge: int = 64, until: str = _STILL) -> Iterator[Tab]:
        """Open a page in a window of edge x edge pixels.

        until: a script that returns true when the page is ready, by default when it has finished drawing. Raises
        NerfbakeError with the page's message if the page fails.
        """
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
        """The CPU time of the browser's GPU process so far, on all cores."""
        found = self._session.send("SystemInfo.getProcessInfo")["processInfo"]
        return float(sum(process["cpuTime"] for process in found if process["type"] == "GPU"))


@contextmanager
def chromium(flags: Sequence[str] = OWN) -> Iterator[Chromium]:
    """Start a headless Chromium. Raises NerfbakeError if it does not start."""
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
    """The pose and the focal length of each camera for the page, in halves of the camera's shorter edge."""
    return [(camera.pose.tolist(), 2 * camera.fx / min(camera.width, camera.height)) for camera in cameras]


NOTE = (
    "ms a frame: CPU time of the browser's GPU process on all cores, median [min..max] over rounds, each the mean of "
    "all cameras' pictures. With a graphics card, use the wall time instead."
)


class Times(NamedTuple):
    """The CPU time (`spent`) and the wall time of a frame in each round, in ms."""

    spent: list[float]
    wall: list[float]

    def ratio(self, other: Times) -> Statistics | None:
        """The ratio to another page's CPU time in the same round; None if drawing takes no CPU time."""
        ratios = [own / by for own, by in zip(self.spent, other.spent, strict=True) if by > 0]
        return Statistics.of(ratios) if ratios else None


def frame_times(
    browser: Chromium, draws: Mapping[str, Callable[[], None]], *, frames: int, rounds: int, progress: Progress
) -> dict[str, Times]:
    """Measure each page; return its times by name. draws: functions that draw `frames` frames of a page."""
    found = {name: Times([], []) for name in draws}
    order = list(draws)
    for turn in range(rounds + 1):
        with progress(f"round {turn} of {rounds}" if turn else "a round that does not count"):
            for name in order:
                before = browser.graphics_seconds()
                _, wall = seconds_of(draws[name])
                spent = browser.graphics_seconds() - before
                if turn:
                    found[name].spent.append(1e3 * spent / frames)
                    found[name].wall.append(1e3 * wall / frames)
        order = order[1:] + order[:1]
    return found
