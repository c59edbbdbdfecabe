"""Draws the README's pictures.

python docs/picture.py              rewrites docs/octree.png: the sample scene as an octree, and cut at coarser levels
python docs/picture.py chair        rewrites docs/chair.png: the real chair in four files; prints their sizes and PSNR
python docs/picture.py page         rewrites docs/page.png: the page of the chair in Chromium, its options open
python docs/picture.py splats       rewrites docs/splats.png: splats, and octrees of 256^3 and 512^3 made of them
python docs/picture.py mesh         rewrites docs/mesh.png: the chair as a field and as a mesh; prints its PSNR
python docs/picture.py capture      rewrites docs/capture.png: a room from photographs; prints the PSNR of its views
"""

from __future__ import annotations

import shutil
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from PIL import Image as Pillow

from benchmarks.scenes import DATA
from nerfbake import (
    Cameras,
    Image,
    Meshes,
    N3Tree,
    Splats,
    Stage1,
    build_field,
    build_octree,
    cut_octree,
    jobs,
    load,
    orbit_cameras,
    render_field,
    render_meshes,
    render_splats,
    render_stage1,
    sample_n3tree,
    save,
)

LEVELS = (8, 7, 6, 5)
CHAIR, CAPTURE = DATA / "plenoctree/chair/chair_sh9.npz", DATA / "nerf_synthetic/chair"
SPLATS = DATA / "splats/biker.spz"
PHONE, PHONE_VIEWS = DATA / "captures/plush", (0, 1, 5, 10)
VIEW, CLOSER = 5, 1.3  # which of the test views is shown, and how much larger


def draw_levels() -> None:
    """Four levels of detail side by side."""
    octree = build_octree(sample_n3tree(resolution=256))
    framed = orbit_cameras(build_field(octree), width=420, height=360).cameras[0]
    camera = replace(framed, focal=1.3 * framed.fx)  # the scene is flatter than the ball around it
    pictures = [render_field(build_field(cut_octree(octree, level=level)), camera) for level in LEVELS]
    _save("octree.png", pictures)


def draw_chair() -> None:
    """The chair as an octree, an index grid in float16, and compressed twice, from left to right."""
    with tempfile.TemporaryDirectory() as folder:
        octree, index, small, smaller = (Path(folder) / name for name in ("a.svo.pb", "b.vdb.npz", "c.svoq", "d.svoq"))
        jobs.bake_octree(CHAIR, octree)
        jobs.bake_volume(CHAIR, index, grids="index", half=True)
        jobs.compress_file(CHAIR, small)
        jobs.compress_file(CHAIR, smaller, goal=jobs.CompressionGoal(max_size=800_000))
        camera = load(CAPTURE / "transforms_test.json", Cameras).cameras[VIEW]
        camera = replace(camera.resized(420, 420), focal=CLOSER * camera.resized(420, 420).fx)
        seen = jobs.ComparedViews(cameras=str(CAPTURE / "transforms_test.json"), truth=str(CAPTURE / "test"))
        pictures = []
        for path in (octree, index, small, smaller):
            found = jobs.compare_files(CHAIR, path, seen=seen).found
            print(f"{path.stat().st_size:,} bytes, {found.means['b_truth']['psnr']:.2f} dB")
            pictures.append(render_field(build_field(load(path)), camera))
    _save("chair.png", pictures)


def draw_page() -> None:
    """What `nerfbake view` makes of the chair, in a dark window."""
    from tests.support.browser import chromium

    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        jobs.view_file(CHAIR, page := Path(folder) / "chair.html", title="A chair", lookup="trilinear")
        with browser.opened(page, viewport={"width": 960, "height": 600}, color_scheme="dark") as seen:
            seen.wait_until_ready()
            seen.page.keyboard.press("o")
            seen.page.mouse.move(530, 200)
            seen.wait_until_still()
            seen.wait_for("document.getElementById('depth').textContent.length > 1")
            seen.page.screenshot(path=Path(__file__).with_name("page.png"))


def draw_capture() -> None:
    """Held-out views of a toy in a room, fitted to photographs of a phone."""
    with tempfile.TemporaryDirectory() as folder:
        phone, scene = Path(folder) / "phone", Path(folder) / "scene.npz"
        shutil.copytree(PHONE / "sparse", phone / "sparse")
        (phone / "images").mkdir()
        for path in (PHONE / "images").iterdir():
            with Pillow.open(path) as photograph:
                photograph.reduce(2).save(phone / "images" / path.name, format="PNG")
        fitted = jobs.fit_file(phone, scene, options=jobs.FitOptions(preset="fast"))
        print(f"{fitted.worked / 2:.0f} seconds on two cores, {fitted.psnr:.2f} dB")
        print(*(f"{view.name} {view.psnr:.2f} dB" for view in fitted.views), sep="\n")
        tree = load(scene, N3Tree)
        assert tree.held_out is not None
        cameras = tree.held_out.cameras.cameras
        field = build_field(tree)
        _save("capture.png", [render_field(field, cameras[i].resized(420, 315), samples=2) for i in PHONE_VIEWS])


def draw_splats() -> None:
    """A real scene of splats, and two octrees of it."""
    splats = load(SPLATS, Splats)
    camera = orbit_cameras(splats, width=300, height=420).cameras[0]
    pictures = [render_splats(splats, camera)]
    with tempfile.TemporaryDirectory() as folder:
        for resolution in (256, 512):
            octree = jobs.bake_octree(SPLATS, Path(folder) / f"{resolution}.svo.npz", resolution=resolution)
            pictures.append(render_field(build_field(octree), camera, samples=2))
    _save("splats.png", pictures)


def draw_mesh() -> None:
    """The chair as a field, as a mesh with highlights, as a mesh with one texture, and its triangles."""
    with tempfile.TemporaryDirectory() as folder:
        for out in (stage1 := Path(folder) / "stage1", glb := Path(folder) / "chair.glb"):
            print(jobs.bake_mesh(CHAIR, out, pictures=jobs.MeshViews(views=str(CAPTURE))).quality)
        glossy, plain = load(stage1, Stage1), load(glb, Meshes)
    camera = load(CAPTURE / "transforms_test.json", Cameras).cameras[VIEW].resized(420, 420)
    camera = replace(camera, focal=CLOSER * camera.fx)
    bare = Meshes((replace(plain.meshes[0], texture=None),))
    pictures = [render_field(build_field(load(CHAIR)), camera, samples=2), render_stage1(glossy, camera, samples=2)]
    _save("mesh.png", pictures + [render_meshes(each, camera, samples=2) for each in (plain, bare)])


def _save(name: str, pictures: list[Image]) -> None:
    parts = ("colour", "alpha", "depth")
    colour, alpha, depth = (np.concatenate([getattr(picture, part) for picture in pictures], axis=1) for part in parts)
    save(Path(__file__).with_name(name), Image(colour, alpha, depth), force=True)


if __name__ == "__main__":
    drawn = {
        "chair": draw_chair,
        "page": draw_page,
        "splats": draw_splats,
        "mesh": draw_mesh,
        "capture": draw_capture,
    }
    drawn.get("".join(sys.argv[1:]), draw_levels)()
