"""A headless Chromium that opens our pages from files: Debian's, driven by Playwright."""

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

PATIENCE = 120  # seconds: software draws, perhaps on a busy machine
_FLAGS = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
_PIXELS = """([pose, focal, edge, looks]) => {
  const camera = new nerfbake.camera.constructor({pose, focal, distance: 1}, nerfbake.facts.up, nerfbake.facts.radius);
  return textOf(nerfbake.picture.pixels(camera, edge, edge, {background: [1, 1, 1], ...looks}));
}"""
# What every page is given beside its own script: an array's bytes as text, a part at a time.
_TEXT = """window.textOf = (array) => {
  const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
  let found = "";
  for (let i = 0; i < bytes.length; i += 4096) found += String.fromCharCode(...bytes.subarray(i, i + 4096));
  return btoa(found);
};"""


def with_a_browser_of_its_own(test: Callable[..., None]) -> Callable[..., None]:
    """A test whose code starts a browser: in a thread, as Playwright drives no more than one from each."""

    @wraps(test)
    def apart(*arguments: Any, **named: Any) -> None:
        with ThreadPoolExecutor(1) as threads:
            threads.submit(test, *arguments, **named).result()

    return apart


class Seen:
    """An opened page, and all that it said and asked for."""

    def __init__(self, page: Any) -> None:
        self.page, self.log = page, []  # type: ignore[var-annotated]
        page.on("console", lambda message: self.log.append(message.text))
        page.on("pageerror", lambda error: self.log.append(str(error)))
        page.on("dialog", lambda dialog: self.log.append(f"dialog {dialog.message}"))
        page.on("request", lambda request: self.log.append(request.url) if "://" in request.url[5:] else None)

    def ask(self, script: str, *arguments: Any) -> Any:
        return self.page.evaluate(script, *arguments)

    @property
    def status(self) -> str:
        return str(self.page.inner_text("#status"))

    def wait_for(self, script: str) -> None:
        """Until the script says so: polled from outside, as the page's policy forbids what Playwright would do."""
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
        """(edge, edge, 3) what the page's shader makes of a square camera, over white; looks: as Picture.look() has
        them."""
        edge = camera.width
        arguments = [camera.pose.tolist(), 2 * camera.fx / edge, edge, looks]
        found = base64.b64decode(self.ask(_PIXELS, arguments))
        return np.frombuffer(found, np.uint8).reshape(edge, edge, 4)[..., :3]


class Browser:
    """One browser for many pages."""

    def __init__(self, chromium: Any) -> None:
        self._chromium = chromium

    @contextmanager
    def opened(self, path: Path, *, hash: str = "", init: str = "", **options: Any) -> Iterator[Seen]:
        """The page in a window of 200 x 200 that nothing turns in, unless the options say otherwise."""
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
    """The browser; skips where it, or what drives it, is missing."""
    playwright = pytest.importorskip("playwright.sync_api")
    program = shutil.which("chromium")
    if program is None:
        pytest.skip("no chromium: `make tools` installs it")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=program, args=_FLAGS)
        yield Browser(browser)
        browser.close()
