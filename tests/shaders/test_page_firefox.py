"""The page in Firefox, where it is installed."""

from __future__ import annotations

import base64
from pathlib import Path

import numpy as np
import pytest

from nerfbake import orbit_cameras, render_field
from tests.support.firefox import firefox
from tests.support.viewed import Made, decibels

pytestmark = [pytest.mark.tools, pytest.mark.slow]
EDGE = 100
PIXELS = """(() => {{
  const camera = new nerfbake.camera.constructor({{pose: {pose}, focal: {focal}, distance: 1}}, nerfbake.facts.up, 1);
  return btoa(String.fromCharCode(...nerfbake.picture.pixels(camera, {edge}, {edge}, {{background: [1, 1, 1]}})));
}})()"""


def test_it_shows_what_render_does(exact: Made, tmp_path: Path) -> None:
    [camera] = orbit_cameras(exact.field, frames=1, width=EDGE, height=EDGE).cameras
    with firefox(tmp_path) as browser:
        browser.open(exact.path)
        browser.wait_for("['ready', 'failed'].includes(window.nerfbake?.state)")
        assert browser.ask("nerfbake.state") == "ready"
        text = browser.ask(PIXELS.format(pose=camera.pose.tolist(), focal=2 * camera.fx / EDGE, edge=EDGE))
        assert browser.log == []
    found = np.frombuffer(base64.b64decode(text), np.uint8).reshape(EDGE, EDGE, 4)[..., :3].astype(np.float64)
    assert decibels(found, render_field(exact.field, camera).pixels.astype(np.float64)) >= 80
