"""Pages with triangles, in a real browser: nerf2mesh's MLP, the atlases baked from it, and what people choose."""

from __future__ import annotations

import base64
import json
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import (
    BakedAtlas,
    Camera,
    Image,
    Meshes,
    Page,
    PageSurface,
    RadianceField,
    Stage1,
    bake_stage1,
    build_field,
    build_octree,
    build_page_field,
    build_page_surface,
    orbit_cameras,
    quantise_octree,
    render_field,
    render_field_and_meshes,
    render_meshes,
    render_stage1,
    round_field,
    sample_n3tree,
    save,
    scatter_cameras,
    weigh_leaves,
)
from nerfbake.formats.mesh import mobilenerf
from nerfbake.scene.atlas import METHODS, Method
from nerfbake.scene.camera import look_at
from tests.support.atlas_scenes import field as specular_field
from tests.support.atlas_scenes import texture
from tests.support.browser import Browser, Seen
from tests.support.meshes import cube, sphere, square
from tests.support.mobilenerf_scenes import phone_files

pytestmark = [pytest.mark.tools, pytest.mark.slow]
EDGE = 120


class Shown(NamedTuple):
    """A page's file, what it carries, and the scenes whose highlights it shows, by their names in the page."""

    path: Path
    surface: PageSurface
    scenes: dict[str, Stage1 | BakedAtlas]


@pytest.fixture(scope="session")
def stage1() -> Stage1:
    """A ball with a soft texture and any MLP."""
    ball = sphere()
    uvs = np.ascontiguousarray(0.5 + 0.5 * ball.positions[:, [0, 2]])
    return Stage1((specular_field(48, 64, hidden=30),), (replace(ball, uvs=uvs, texture=texture(48, 64, seed=1) // 2),))


@pytest.fixture(scope="session")
def shown(folder: Path, stage1: Stage1) -> dict[Method, Shown]:
    return {method: made(folder, stage1, method) for method in METHODS}


@pytest.fixture(scope="session")
def kmeans(shown: dict[Method, Shown]) -> Shown:
    return shown["kmeans"]


def made(folder: Path, stage1: Stage1, method: Method) -> Shown:
    options: dict[str, Any] = {"map_size": 16} | ({} if method == "grid" else {"clusters": 16})
    atlas = bake_stage1(stage1, method=method, **options)
    path, surface = folder / f"{method}.html", build_page_surface(atlas, stage1=stage1)
    cameras = orbit_cameras(stage1, width=40, height=40)
    save(path, Page(surface, None, cameras, render_stage1(atlas, cameras.cameras[0]), "A ball"))
    return Shown(path, surface, {method: atlas, "mlp_constants": stage1, "mlp_textures": stage1})


def views(scene: Stage1 | BakedAtlas) -> tuple[Camera, ...]:
    return orbit_cameras(scene, frames=2, width=EDGE, height=EDGE).cameras


def error(found: npt.NDArray[np.uint8], wanted: Image) -> npt.NDArray[np.float64]:
    """(H, W) squared, the mean of the channels, in 0..1."""
    return np.asarray(((found.astype(np.float64) - wanted.pixels) ** 2).mean(axis=2) / 255**2)


# -- what is seen ----------------------------------------------------------------------------------------------
@pytest.mark.parametrize("method", METHODS)
def test_every_atlas_is_what_python_renders(browser: Browser, shown: dict[Method, Shown], method: Method) -> None:
    with browser.opened(shown[method].path) as page:
        page.wait_until_ready()
        assert page.ask("nerfbake.facts.triangles.highlights") == [method, "mlp_constants", "mlp_textures", "none"]
        assert_same_pictures(page, shown[method], method)
        assert page.log == []


@pytest.mark.parametrize("highlights", ["mlp_constants", "mlp_textures"])
def test_so_is_the_mlp_however_it_is_written(browser: Browser, kmeans: Shown, highlights: str) -> None:
    with browser.opened(kmeans.path) as page:
        page.wait_until_ready()
        assert_same_pictures(page, kmeans, highlights)


def assert_same_pictures(page: Seen, shown: Shown, highlights: str) -> None:
    """At rest the page shows 2x2 rays a pixel. A graphics card rounds corners to a part of a pixel, a sixteenth in
    software, so that at the rim some rays meet what others miss: with one ray a pixel the rim is left out."""
    scene = shown.scenes[highlights]
    for camera in views(scene):
        fine = page.pixels(camera, highlights=highlights, rays=2)
        assert error(fine, render_stage1(scene, camera, samples=2)).mean() <= 10**-4.5
        apart = error(page.pixels(camera, highlights=highlights), render_stage1(scene, camera))
        rim = apart > 0.02
        assert rim.mean() < 0.005
        assert apart[~rim].mean() <= 10**-4.5


def test_without_highlights_only_the_diffuse_colour_is_left(browser: Browser, kmeans: Shown) -> None:
    camera = views(kmeans.scenes["mlp_constants"])[0]
    with browser.opened(kmeans.path) as page:
        page.wait_until_ready()
        bare, lit = (page.pixels(camera, highlights=name).astype(int) for name in ("none", "mlp_constants"))
        seen = page.pixels(camera, highlights="none", background=[0, 0, 0]).any(axis=2)
    wanted = render_meshes(Meshes(kmeans.surface.meshes), camera)
    assert np.median(np.abs(bare - wanted.pixels)[seen]) == 0
    assert seen.mean() > 0.1
    assert (lit - bare)[seen].min() >= 0
    assert (lit - bare)[seen].max() > 100


def test_what_is_carried_comes_out_bit_for_bit(browser: Browser, kmeans: Shown) -> None:
    script = """async () => {
      const {parts: [part], weights} = await nerfbake.carried.triangles();
      const arrays = Object.entries({...part, ...part.textures, ...weights}).filter(([, it]) => it.buffer);
      return Object.fromEntries(arrays.map(([name, it]) => [name, textOf(it)]));
    }"""
    with browser.opened(kmeans.path) as page:
        page.wait_until_ready()
        found = {name: base64.b64decode(text) for name, text in page.ask(script).items()}
    [mesh], [field], [atlas] = kmeans.surface.meshes, kmeans.surface.fields, kmeans.surface.atlases
    labels = np.stack([atlas.labels & 255, atlas.labels >> 8, 0 * atlas.labels], axis=-1).astype(np.uint8)
    arrays = {"positions": mesh.positions, "faces": mesh.faces, "uvs": mesh.uvs, "diffuse": mesh.texture}
    arrays |= {"atlas": atlas.image, "labels": labels, "mlpFeatures": field.features}
    arrays |= {"weights0": field.w0.T, "weights1": field.w1}
    assert found == {name: np.asarray(array).tobytes() for name, array in arrays.items()}


# -- what people do --------------------------------------------------------------------------------------------
def test_highlights_are_chosen_from_a_list_and_keys_show_what_there_is(browser: Browser, kmeans: Shown) -> None:
    with browser.opened(kmeans.path, viewport={"width": 320, "height": 480}) as page:
        page.wait_until_ready()
        assert page.ask("nerfbake.shown.highlights") == "kmeans"
        page.page.select_option("#highlights", "mlp_textures")
        assert page.ask("nerfbake.shown.highlights") == "mlp_textures"
        page.ask("nerfbake.choose('highlights', 'none')")
        assert page.page.input_value("#highlights") == "none"
        # Neither first coefficients nor steps a ray: there is no ray that marches.
        assert page.ask("[...document.getElementById('mode').options].map((one) => one.value)") == ["colour", "depth"]
        for key, mode in (("2", "depth"), ("3", "depth"), ("5", "depth"), ("1", "colour")):
            page.page.keyboard.press(key)
            assert page.ask("nerfbake.looks.mode") == mode
        for control in page.page.query_selector_all("#tools :is(button, select):not([hidden])"):
            box = control.bounding_box()
            assert 0 <= box["x"] <= 320 - box["width"]
        before = page.ask("nerfbake.camera.pose")
        page.page.mouse.dblclick(160, 200)
        page.wait_for(f"JSON.stringify(nerfbake.camera.pose) !== {json.dumps(json.dumps(before))}")
        page.wait_until_still()
        assert page.log == []


def test_a_double_click_finds_the_surface(browser: Browser, kmeans: Shown) -> None:
    camera = views(kmeans.scenes["kmeans"])[0]
    depth = render_stage1(kmeans.scenes["kmeans"], camera).depth
    with browser.opened(kmeans.path, viewport={"width": EDGE, "height": EDGE}) as page:
        page.wait_until_ready()
        script = """([pose, focal, x, y]) => {
          const {facts, picture, camera, shown} = nerfbake, view = {pose, focal, distance: 1};
          return picture.distanceAt(new camera.constructor(view, facts.up, facts.radius), x, y, shown);
        }"""
        rows, columns = np.nonzero((depth > 0) & (depth < np.quantile(depth[depth > 0], 0.8)))  # not at the rim
        for at in np.linspace(0, len(rows) - 1, 9).astype(int)[1:-1]:
            x, y = int(columns[at]), int(rows[at])
            place = [camera.pose.tolist(), 2 * camera.fx / EDGE, x + 0.5, y + 0.5]
            assert page.ask(script, place) == pytest.approx(float(depth[y, x]), rel=2e-3)
        assert page.ask(script, [camera.pose.tolist(), 2 * camera.fx / EDGE, 1, 1]) is None


def test_graphics_that_are_lost_come_back(browser: Browser, kmeans: Shown) -> None:
    camera = views(kmeans.scenes["kmeans"])[0]
    with browser.opened(kmeans.path) as page:
        page.wait_until_ready()
        before = page.pixels(camera)
        page.ask("window.lose = nerfbake.picture.gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
        page.wait_for("nerfbake.state === 'lost'")
        page.ask("lose.restoreContext()")
        page.wait_until_ready()
        np.testing.assert_array_equal(page.pixels(camera), before)


# -- what goes wrong -------------------------------------------------------------------------------------------
def test_a_device_with_small_textures_says_so(browser: Browser, kmeans: Shown) -> None:
    init = """const ask = WebGL2RenderingContext.prototype.getParameter;
      WebGL2RenderingContext.prototype.getParameter = function (name) {
        return name === this.MAX_TEXTURE_SIZE ? 48 : ask.call(this, name);
      };"""
    with browser.opened(kmeans.path, init=init) as page:
        page.wait_for("nerfbake.state === 'failed'")
        assert "a texture of 72 texels is more than the 48 that this device's graphics hold" in page.status
        assert page.log == []


# -- beside a field --------------------------------------------------------------------------------------------
class Room(NamedTuple):
    """A page's file, and the field and the meshes that it shows together."""

    path: Path
    field: RadianceField
    meshes: Meshes


@pytest.fixture(scope="session")
def room(folder: Path) -> Room:
    """A field with a floor that it stands on, a textured wall behind it, and cubes that stick out of it."""
    field = round_field(build_field(sample_n3tree(resolution=32, basis="SH4")))
    low, high = field.world(field.box)
    wall = np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0]], np.float32)
    texture = np.random.default_rng(1).integers(0, 255, (8, 8, 3), np.uint8)
    floor, back = square(float(low[2]) - 0.01, 2.0), square(float(high[1]) + 0.3, 1.0)
    colours = np.linspace(0, 1, 24, dtype=np.float32).reshape(8, 3)
    meshes = Meshes(
        (
            replace(floor, uvs=None),
            replace(back, positions=back.positions @ wall, texture=texture),
            cube(0.35, colours=colours),
        )
    )
    path = folder / "room.html"
    camera = orbit_cameras(field, width=40, height=40)
    cover = render_field_and_meshes(field, meshes, camera.cameras[0])
    save(path, Page(build_page_field(field), field, camera, cover, "A room", meshes=meshes.meshes))
    return Room(path, field, meshes)


@pytest.mark.parametrize(
    ("composite", "how", "options"),
    [
        ("stop", "stop", {}),
        ("ztest", "ztest", {}),
        ("cutout", "stop", {"transmittance_cut": 0.5}),
        ("stop", "stop", {"lookup": "trilinear"}),
        ("ztest", "ztest", {"lookup": "trilinear"}),
    ],
)
def test_a_field_and_meshes_are_what_python_renders(
    browser: Browser, room: Room, composite: str, how: Any, options: Any
) -> None:
    with browser.opened(room.path) as page:
        page.wait_until_ready()
        facts = page.ask("nerfbake.facts")
        looks = {"composite": composite, "smoothly": options.get("lookup") == "trilinear", "rays": 2}
        for camera in orbit_cameras(room.field, frames=2, width=EDGE, height=EDGE).cameras:
            wanted = render_field_and_meshes(room.field, room.meshes, camera, how=how, samples=2, **options)
            found = page.pixels(camera, **looks)
            assert error(found, wanted).mean() <= 10**-4.0
            # Depth is shown ray by ray: those of four pixels are one pixel's.
            finer = camera.resized(2 * EDGE, 2 * EDGE)
            each = render_field_and_meshes(room.field, room.meshes, finer, how=how, **options)
            away = float(np.linalg.norm(camera.pose[:3, 3] - facts["centre"]))
            part = np.clip((each.depth - away) / (2 * facts["radius"]) + 0.5, 0, 1)
            grey = (1 - each.alpha * 0.85 * part).reshape(EDGE, 2, EDGE, 2).mean(axis=(1, 3))
            depth = page.pixels(camera, mode="depth", **looks)[..., 0] / 255
            assert ((depth - grey) ** 2).mean() <= 10**-4.0
        assert page.log == []


def test_the_ways_to_see_both_differ_and_are_chosen_from_a_list(browser: Browser, room: Room) -> None:
    camera = orbit_cameras(room.field, width=EDGE, height=EDGE).cameras[0]
    with browser.opened(room.path) as page:
        page.wait_until_ready()
        ways = page.ask("nerfbake.facts.triangles.composites")
        assert ways == ["stop", "ztest", "cutout"]
        pictures = [page.pixels(camera, composite=way) for way in ways]
        for i in range(3):
            assert (pictures[i] != pictures[i - 1]).any()
        page.page.select_option("#composite", "ztest")
        assert page.ask("nerfbake.shown.composite") == "ztest"
        assert page.ask("document.getElementById('highlights')") is None


def test_the_field_throws_the_shadow_that_its_density_makes(browser: Browser, room: Room) -> None:
    # From below, where nothing hides what is thrown on the floor.
    camera = Camera(EDGE, EDGE, 1.5 * EDGE, look_at(np.zeros(3), 0.5, -0.8, 5.0))
    depth = render_meshes(room.meshes, camera).depth
    floor = render_meshes(Meshes(room.meshes.meshes[:1]), camera).depth
    places = np.argwhere((depth > 0) & (depth == floor))
    with browser.opened(room.path) as page:
        page.wait_until_ready()
        lit, shaded = (page.pixels(camera, shadow=shadow)[..., 0] / 255 for shadow in (False, True))
        page.page.click("#shadow")
        assert page.ask("nerfbake.shown.shadow") is True
        assert page.page.get_attribute("#shadow", "aria-pressed") == "true"
    _, looks = camera.rays()
    lost = []
    for row, column in places[:: max(1, len(places) // 150)]:
        stand = camera.pose[:3, 3] + depth[row, column] * looks[row * EDGE + column]
        upwards = np.eye(4)
        upwards[:3, :3], upwards[:3, 3] = np.stack([[1, 0, 0], [0, -1, 0], [0, 0, -1]], axis=1), stand
        alpha = float(render_field(room.field, Camera(1, 1, 1.0, upwards)).alpha[0, 0])
        assert shaded[row, column] / lit[row, column] == pytest.approx(1 - 0.6 * alpha, abs=0.03)
        lost.append(alpha)
    assert min(lost) == 0
    assert max(lost) > 0.5


def test_triangles_stand_behind_compressed_data_and_coarser_levels(browser: Browser, room: Room, folder: Path) -> None:
    octree = build_octree(sample_n3tree(resolution=32, basis="SH4"))
    importance = weigh_leaves(build_field(octree), scatter_cameras(room.field, frames=4, edge=32))
    quantised = quantise_octree(octree, importance, step=0.02)
    cameras = orbit_cameras(room.field, width=40, height=40)
    cover = render_field(room.field, cameras.cameras[0])
    save(folder / "packed.html", Page(quantised, room.field, cameras, cover, "A room", meshes=room.meshes.meshes))
    camera = cameras.cameras[0].resized(EDGE, EDGE)
    wanted = render_field_and_meshes(room.field, room.meshes, camera, samples=2)
    with browser.opened(folder / "packed.html") as page:
        page.wait_until_ready()
        assert error(page.pixels(camera, rays=2), wanted).mean() <= 10**-3.0
        page.ask("nerfbake.panel.choose(1)")
        assert error(page.pixels(camera, rays=2), wanted).mean() <= 10**-1.5
        assert page.log == []


# -- MobileNeRF ----------------------------------------------------------------------------------------------------
def test_mobilenerf_s_mlp_and_holes_are_what_python_renders(browser: Browser, folder: Path) -> None:
    scene = mobilenerf.decode({name: memoryview(data) for name, data in phone_files().items()})
    path, cameras = folder / "phone.html", orbit_cameras(scene, width=40, height=40)
    save(path, Page(build_page_surface(scene), None, cameras, render_stage1(scene, cameras.cameras[0]), "Quads"))
    with browser.opened(path) as page:
        page.wait_until_ready()
        assert page.ask("nerfbake.facts.triangles.highlights") == ["mlp_constants", "none"]
        for camera in views(scene):
            apart = error(page.pixels(camera, highlights="mlp_constants"), render_stage1(scene, camera))
            rim = apart > 0.001
            assert rim.mean() < 0.03  # rays at the edges of texels
            assert apart[~rim].mean() <= 10**-5
        assert page.log == []
