"""Let three.js draw a .ply of splats in a headless Chromium, for findings. Needs playwright and chromium."""

import base64
import shutil
from pathlib import Path

import numpy as np
from playwright.sync_api import sync_playwright

_MODULES = Path("node_modules")
_HOST = "http://three.test"
_PAGE = """<!doctype html><script type="importmap">{"imports": {"three": "/three/build/three.webgpu.js",
"three/webgpu": "/three/build/three.webgpu.js", "three/tsl": "/three/build/three.tsl.js"}}</script>
<script type="module">
import * as three from "three";
import { GaussianSplatPLYLoader } from "/three/examples/jsm/loaders/GaussianSplatPLYLoader.js";
import { GaussianSplat } from "/three/examples/jsm/objects/GaussianSplat.js";
window.drawn = async (place, edge, space) => {
  const scene = new three.Scene(), camera = new three.PerspectiveCamera(60, 1, 0.01, 100);
  scene.add(new GaussianSplat(await new GaussianSplatPLYLoader().loadAsync("/in.ply")));
  scene.background = new three.Color(0, 0, 0);
  camera.position.set(...place);
  camera.lookAt(0, 0, 0);
  const renderer = new three.WebGPURenderer({forceWebGL: true, antialias: false});
  if (space) renderer.outputColorSpace = three[space];
  await renderer.init();
  renderer.setSize(edge, edge, false);
  renderer.render(scene, camera);
  const copy = new OffscreenCanvas(edge, edge).getContext("2d");
  copy.drawImage(renderer.domElement, 0, 0);
  return btoa(String.fromCharCode(...copy.getImageData(0, 0, edge, edge).data));
};
window.ready = true;
</script>"""


def draw(ply, *views, edge=61):
    """Return a picture (edge, edge, 3) in bytes, over black, of each view: the place of the camera, which looks at
    the origin over 60 degrees, and the output colour space, '' for the default."""

    def answer(route):
        name = route.request.url.removeprefix(_HOST)
        if name == "/":
            route.fulfill(body=_PAGE, content_type="text/html")
        elif name == "/in.ply":
            route.fulfill(body=Path(ply).read_bytes())
        else:
            route.fulfill(path=_MODULES / name.strip("/"), content_type="text/javascript")

    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
    with sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=shutil.which("chromium"), args=flags)
        page = browser.new_page()
        page.route(f"{_HOST}/**", answer)
        page.goto(f"{_HOST}/")
        page.wait_for_function("window.ready")
        found = [page.evaluate("(given) => drawn(...given)", [place, edge, space]) for place, space in views]
        browser.close()
    return [np.frombuffer(base64.b64decode(each), np.uint8).reshape(edge, edge, 4)[..., :3] for each in found]
