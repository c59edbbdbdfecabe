"""Open pages from files in a headless Chromium: Debian's build, driven by Playwright."""

from __future__ import annotations

import base64
import shutil
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import wraps
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import Camera

PATIENCE = 120  # seconds: software rendering, possibly on a busy machine
_FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_HINT = "GPU stall due to ReadPixels"  # comes from tests that read pixels, on slow machines only
_PIXELS = """([pose, focal, edge, looks]) => {
  const camera = new nerfbake.camera.constructor({pose, focal, distance: 1}, nerfbake.facts.up, nerfbake.facts.radius);
  return textOf(nerfbake.picture.pixels(camera, edge, edge, {background: [1, 1, 1], ...looks}));
}"""
# Added to every page: returns the bytes of an array as text. It converts them in parts.
_TEXT = """window.textOf = (array) => {
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  let found = "";
  for (let i = 0; i < bytes.length; i += 4096) found += String.fromCharCode(...bytes.subarray(i, i + 4096));
  return btoa(found);
};"""


def with_a_browser_of_its_own(test: Callable[..., None]) -> Callable[..., None]:
    """Run a test that starts its own browser in a new thread: Playwright drives only one browser per thread."""

    @wraps(test)
    def apart(*arguments: Any, **named: Any) -> None:
        with ThreadPoolExecutor(1) as threads:
            threads.submit(test, *arguments, **named).result()

    return apart


class Seen:
    """An open page. log: its console messages, errors, dialogs and network requests."""

    def __init__(self, page: Any) -> None:
        self.page, self.log = page, []  # type: ignore[var-annotated]
        page.on("console", lambda message: None if _HINT in message.text else self.log.append(message.text))
        page.on("pageerror", lambda error: self.log.append(str(error)))
        page.on("dialog", lambda dialog: self.log.append(f"dialog {dialog.message}"))
        page.on("request", lambda request: self.log.append(request.url) if "://" in request.url[5:] else None)

    def ask(self, script: str, *arguments: Any) -> Any:
        return self.page.evaluate(script, *arguments)

    @property
    def status(self) -> str:
        return str(self.page.inner_text("#status"))

    def wait_for(self, script: str) -> None:
        """Wait until the script returns true. Polls from outside: the page's policy blocks Playwright's own waiting."""
        end = time.monotonic() + PATIENCE
        while not self.ask(script):
            assert time.monotonic() < end, f"{script}: {self.status} {self.log}"
            time.sleep(0.1)

    def wait_until_ready(self) -> None:
        self.wait_for("['ready', 'failed'].includes(window.nerfbake?.state)")
        assert self.ask("nerfbake.state") == "ready", self.status

    def wait_until_still(self) -> None:
        self.wait_for("nerfbake.finished && !nerfbake.asked && !nerfbake.busy")

    def pixels(self, camera: Camera, **looks: Any) -> npt.NDArray[np.uint8]:
        """(edge, edge, 3) uint8: the picture that the page's shader renders for a square camera, over white.

        looks: options of the page's Picture.look().
        """
        edge = camera.width
        arguments = [camera.pose.tolist(), 2 * camera.fx / edge, edge, looks]
        found = base64.b64decode(self.ask(_PIXELS, arguments))
        return np.frombuffer(found, np.uint8).reshape(edge, edge, 4)[..., :3]


class Browser:
    """A browser process that opens many pages."""

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium

    @contextmanager
    def opened(self, path: Path, *, hash: str = "", init: str = "", **options: Any) -> Iterator[Seen]:
        """Open a page in a window of 200 x 200 with reduced motion, unless the options differ."""
        options = {"viewport": {"width": 200, "height": 200}, "reduced_motion": "reduce", **options}
        context = self._chromium.new_context(**options)
        context.add_init_script(_TEXT + init)
        seen = Seen(context.new_page())
        seen.page.goto(f"file://{path}{hash}")
        try:
            yield seen
        finally:
            context.close()


@contextmanager
def chromium() -> Iterator[Browser]:
    """Start the browser. Skips the test if Chromium or Playwright is not installed."""
    playwright = pytest.importorskip("playwright.sync_api")
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("no chromium: `make tools` installs it")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=_FLAGS)
        yield Browser(browser)
        browser.close()
