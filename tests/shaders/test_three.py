"""three.js shows our .glb files as `nerfbake render` and our own page show them. `make tools` installs it for tests."""

from __future__ import annotations

import base64
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import Camera, Meshes, load, orbit_cameras, render_meshes, sample_stage1, save
from nerfbake.jobs import view_file
from tests.conftest import REPOSITORY
from tests.support.browser import Browser

MODULES = REPOSITORY / "tests" / "shaders" / "scripts" / "node_modules" / "three"
HOST, EDGE = "http://three.test", 160
pytestmark = [
    pytest.mark.tools,
    pytest.mark.slow,
    pytest.mark.skipif(not MODULES.exists(), reason="no three.js: `make tools` installs it"),
]
_PAGE = """<!doctype html><p id="status"></p>
<script type="importmap">{"imports": {"three": "/build/three.module.js"}}</script>
<script type="module">
import * as three from "three";
import { GLTFLoader } from "/examples/jsm/loaders/GLTFLoader.js";
window.shown = async (path, pose, angle, edge) => {
  const gltf = await new GLTFLoader().loadAsync(path), scene = new three.Scene();
  scene.add(gltf.scene);
  scene.background = new three.Color(1, 1, 1);
  const camera = new three.PerspectiveCamera(angle, 1, 0.01, 100);
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...pose.flat());
  camera.matrixWorldNeedsUpdate = true;
  const renderer = new three.WebGLRenderer({antialias: false, preserveDrawingBuffer: true});
  renderer.setSize(edge, edge, false);
  renderer.render(scene, camera);
  const gl = renderer.getContext(), pixels = new Uint8Array(4 * edge * edge);
  gl.readPixels(0, 0, edge, edge, gl.RGBA, gl.UNSIGNED_BYTE, pixels);
  return textOf(pixels);
};
window.state = "ready";
</script>"""


def textured() -> Meshes:
    (torus,) = sample_stage1(resolution=128).meshes
    assert torus is not None
    return Meshes((replace(torus, positions=(torus.positions * [1, 1, 0.8] + [0.3, -0.2, 5]).astype(np.float32)),))


def shown(browser: Browser, path: Path, camera: Camera, page: str = _PAGE) -> npt.NDArray[np.uint8]:
    """(edge, edge, 3) what three.js renders of a file."""
    with browser.opened(Path("/dev/null")) as seen:

        def answer(route: Any) -> None:
            name = route.request.url.removeprefix(HOST)
            if name == "/":
                route.fulfill(body=page, content_type="text/html")
            elif name == f"/{path.name}":
                route.fulfill(body=path.read_bytes(), content_type="model/gltf-binary")
            else:
                route.fulfill(path=MODULES / name.strip("/"), content_type="text/javascript")

        seen.page.route(f"{HOST}/**", answer)
        seen.page.goto(f"{HOST}/")
        seen.wait_for("window.state === 'ready'")
        angle = 2 * float(np.degrees(np.arctan(0.5 * camera.height / camera.fy)))
        given = [f"/{path.name}", camera.pose.tolist(), angle, camera.width]
        found = seen.ask("(given) => shown(...given)", given)
        faults = [line for line in seen.log if not line.startswith(HOST) and "GPU stall" not in line]
        known = ("blob:", "vendor extensions are not supported")
        assert [line for line in faults if not any(part in line for part in known)] == []
    return np.frombuffer(base64.b64decode(found), np.uint8).reshape(camera.height, camera.width, 4)[::-1, :, :3]


def error(found: npt.NDArray[np.uint8], camera: Camera, scene: Meshes) -> tuple[float, float]:
    """The share of pixels that differ much, along the rim, and the mean squared error of the others, in 0..1."""
    apart = ((found.astype(np.float64) - render_meshes(scene, camera).pixels[..., :3]) ** 2).mean(axis=2) / 255**2
    rim = apart > 0.02
    return float(rim.mean()), float(apart[~rim].mean())


@pytest.mark.parametrize("options", [{}, {"quantised": True}, {"quantised": True, "image": "webp"}], ids=str)
@pytest.mark.parametrize("levels", [0, 1])
def test_three_shows_what_we_render(browser: Browser, options: dict[str, Any], levels: int, tmp_path: Path) -> None:
    scene = textured()
    coarse = replace(scene.meshes[0], faces=scene.meshes[0].faces[:9])
    save(tmp_path / "a.glb", replace(scene, coarser=(coarse,) * levels), **options)
    back = load(tmp_path / "a.glb", Meshes)
    for camera in orbit_cameras(back, frames=2, width=EDGE, height=EDGE).cameras:
        rim, rest = error(shown(browser, tmp_path / "a.glb", camera), camera, back)
        assert rim < 0.01
        assert rest < 10**-3.5


def test_our_page_shows_a_mesh_as_it_is_rendered(browser: Browser, tmp_path: Path) -> None:
    save(tmp_path / "a.glb", textured(), quantised=True)
    view_file(tmp_path / "a.glb", tmp_path / "a.html")
    back = load(tmp_path / "a.glb", Meshes)
    with browser.opened(tmp_path / "a.html") as page:
        page.wait_until_ready()
        for camera in orbit_cameras(back, frames=2, width=EDGE, height=EDGE).cameras:
            rim, rest = error(page.pixels(camera), camera, back)
            assert rim < 0.01
            assert rest < 10**-4
        assert page.ask("document.getElementById('highlights')") is None
        assert page.log == []
