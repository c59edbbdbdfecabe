"""three.js draws our files of splats as `nerfbake render` does: where they stand, their shapes, and their colours."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from nerfbake import Camera, Splats, render_splats, save
from nerfbake.scene.camera import look_at
from tests.shaders.test_three import MODULES, shown
from tests.support.browser import Browser

EDGE = 160
pytestmark = [
    pytest.mark.tools,
    pytest.mark.slow,
    pytest.mark.skipif(not MODULES.exists(), reason="no three.js: `make tools` installs it"),
]
# Its colours are sRGB, which the renderer would convert to sRGB once more.
_PAGE = """<!doctype html><p id="status"></p>
<script type="importmap">{"imports": {"three": "/build/three.webgpu.js", "three/webgpu": "/build/three.webgpu.js",
"three/tsl": "/build/three.tsl.js"}}</script>
<script type="module">
import * as three from "three";
import { GLTFGaussianSplatLoaderExtension } from "/examples/jsm/loaders/GLTFGaussianSplatLoaderExtension.js";
import { GLTFLoader } from "/examples/jsm/loaders/GLTFLoader.js";
import { GaussianSplatPLYLoader } from "/examples/jsm/loaders/GaussianSplatPLYLoader.js";
import { SPZLoader } from "/examples/jsm/loaders/SPZLoader.js";
import { GaussianSplat } from "/examples/jsm/objects/GaussianSplat.js";
const opened = async (path) => {
  if (path.endsWith(".ply")) return new GaussianSplat(await new GaussianSplatPLYLoader().loadAsync(path));
  if (path.endsWith(".spz")) return new GaussianSplat(await new SPZLoader().loadAsync(path));
  const loader = new GLTFLoader();
  loader.register((parser) => new GLTFGaussianSplatLoaderExtension(parser));
  return (await loader.loadAsync(path)).scene;
};
window.shown = async (path, pose, angle, edge) => {
  const scene = new three.Scene(), camera = new three.PerspectiveCamera(angle, 1, 0.01, 100);
  scene.add(await opened(path));
  scene.background = new three.Color(1, 1, 1);
  camera.matrixAutoUpdate = false;
  camera.matrix.set(...pose.flat());
  camera.matrixWorldNeedsUpdate = true;
  const renderer = new three.WebGPURenderer({forceWebGL: true, antialias: false});
  renderer.outputColorSpace = three.LinearSRGBColorSpace;
  await renderer.init();
  renderer.setSize(edge, edge, false);
  renderer.render(scene, camera);
  const copy = new OffscreenCanvas(edge, edge).getContext("2d");
  copy.translate(0, edge);
  copy.scale(1, -1);
  copy.drawImage(renderer.domElement, 0, 0);
  return textOf(copy.getImageData(0, 0, edge, edge).data);
};
window.state = "ready";
</script>"""


def blobs() -> Splats:
    """Ellipsoids of degree 2, with coefficients that three.js does not cut off."""
    rng = np.random.default_rng(4)
    n = 60
    quats = rng.normal(size=(n, 4))
    return Splats(
        means=rng.normal(size=(n, 3)).astype(np.float32) * np.array([0.3, 0.5, 0.2], np.float32),
        scales=np.exp(rng.uniform(-4, -1.6, (n, 3))).astype(np.float32),
        quats=(quats / np.linalg.norm(quats, axis=1, keepdims=True)).astype(np.float32),
        opacity=rng.uniform(0.3, 1, n).astype(np.float32),
        sh=np.concatenate([rng.uniform(-1.4, 1.4, (n, 1, 3)), rng.uniform(-0.4, 0.4, (n, 8, 3))], axis=1).astype("f4"),
        antialiased=True,
    )


@pytest.mark.parametrize(
    ("name", "options", "turn"),
    [
        ("a.glb", {}, (-1, -1, 1)),
        ("a.spz", {}, (1, -1, -1)),
        ("a.spz", {"spz_version": 3}, (1, -1, -1)),
    ],
)
def test_three_draws_splats_as_we_do(
    browser: Browser, name: str, options: dict[str, Any], turn: tuple[int, ...], tmp_path: Path
) -> None:
    """turn: the axes of the file in the world."""
    scene = blobs()
    save(tmp_path / name, scene, **options)
    camera = Camera(EDGE, EDGE, 1.2 * EDGE, look_at(np.zeros(3), 0.7, 0.4, 3.0, np.eye(3)))
    placed = replace(camera, pose=np.diag([*turn, 1.0]) @ camera.pose)
    seen = shown(browser, tmp_path / name, placed, _PAGE).astype(float)
    ours = render_splats(scene, camera).pixels[..., :3]
    assert np.abs(seen - ours).mean() < 3  # of 255: three.js ends a splat at two standard deviations
    assert np.abs(seen[::-1] - ours).mean() > 10
