"""The page that `nerfbake view` writes, in a real browser: its pictures, its decoder, and what people do with it."""

from __future__ import annotations

import base64
import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pytest

from nerfbake import (
    Cameras,
    N3Tree,
    Page,
    PageField,
    RadianceField,
    build_field,
    build_octree,
    build_page_field,
    load,
    orbit_cameras,
    quantise_octree,
    render_field,
    round_field,
    sample_n3tree,
    save,
    sphere_cameras,
    weigh_leaves,
)
from tests.support.browser import Browser, Seen, chromium
from tests.support.scenes import n3tree

pytestmark = [pytest.mark.tools, pytest.mark.slow]
EDGE = 200
HOSTILE = '"><img src=x onerror=alert(1)></title><script>alert(2)</script>{{data}}&amp;\n\x1b[2J\u202e'


class Made(NamedTuple):
    """A page's file, the field that it shows, and the arrays that its shader should get."""

    path: Path
    field: RadianceField
    arrays: PageField


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with chromium() as found:
        yield found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("pages")


@pytest.fixture(scope="module")
def exact(folder: Path) -> Made:
    return exact_page(folder / "exact.html", build_field(sample_n3tree(resolution=32)), "A sample")


def exact_page(path: Path, field: RadianceField, title: str = "A page") -> Made:
    arrays = build_page_field(field)
    save(path, view_of(arrays, field, title))
    return Made(path, round_field(field), arrays)


def compressed_page(path: Path, basis: str) -> Made:
    octree = build_octree(sample_n3tree(resolution=32, basis=basis))
    field = build_field(octree)
    importance = weigh_leaves(field, sphere_cameras(field, frames=4, edge=32))
    quantised = quantise_octree(octree, importance, step=0.05, prune=0.1)
    save(path, view_of(quantised, field))
    shown = replace(build_field(quantised.restored()), box=field.box)
    return Made(path, round_field(shown), build_page_field(shown))


def view_of(content: object, field: RadianceField, title: str = "A page") -> Page:
    cameras = orbit_cameras(field, width=40, height=40)
    return Page(content, field, cameras, render_field(field, cameras.cameras[0]), title)  # type: ignore[arg-type]


def anisotropic() -> RadianceField:
    """SH16 in float32, over a box that is no cube, away from the world's origin."""
    octree = build_octree(sample_n3tree(resolution=32, basis="SH16"), resolution=(24, 32, 17))
    random = np.random.default_rng(0).normal(1, 0.01, octree.node_data.shape)
    values = (octree.node_data * random).astype(np.float32)
    return build_field(replace(octree, node_data=values, voxel_size=np.array([0.1, 0.05, 0.2]), origin=np.full(3, 5.0)))


def assert_same_pictures(page: Seen, made: Made) -> None:
    """Two views, each at least 80 dB, and hardly a channel further off than its rounding."""
    for camera in orbit_cameras(made.field, frames=2, width=EDGE, height=EDGE).cameras:
        wanted = render_field(made.field, camera).pixels.astype(np.float64)
        found = page.pixels(camera).astype(np.float64)
        assert (np.abs(found - wanted) > 1).mean() <= 1e-4
        assert ((found - wanted) ** 2).mean() / 255**2 <= 10**-8.0


# -- what is seen ----------------------------------------------------------------------------------------------
def test_an_exact_page_shows_what_render_does(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        assert_same_pictures(page, exact)


@pytest.mark.parametrize("kind", ["SH16 in a box", "RGBA"])
def test_so_does_every_kind_of_field(browser: Browser, folder: Path, kind: str) -> None:
    field = (
        anisotropic() if kind != "RGBA" else build_field(n3tree([(0, (1, 0, 1)), (1, (0, 1, 0))], data_format="RGBA"))
    )
    made = exact_page(folder / f"{kind}.html", field)
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        assert_same_pictures(page, made)


@pytest.mark.parametrize("basis", ["SH9", "SH1"])
def test_a_compressed_page_decodes_to_the_bit_what_python_does(browser: Browser, folder: Path, basis: str) -> None:
    made = compressed_page(folder / f"{basis}.html", basis)
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        found = unpacked(page)
        np.testing.assert_array_equal(found["top"].view(np.int32), made.arrays.top.reshape(-1))
        np.testing.assert_array_equal(found["blocks"].view(np.uint32), made.arrays.blocks.reshape(-1))
        np.testing.assert_array_equal(found["texels"].view(np.float16), made.arrays.texels.reshape(-1))
        assert_same_pictures(page, made)


def unpacked(page: Seen) -> dict[str, npt.NDArray[np.uint8]]:
    """The arrays as the page's own script unpacks them."""
    script = """async () => {
      const {top, blocks, texels} = await nerfbake.unpack();
      return {top: textOf(top), blocks: textOf(blocks), texels: textOf(texels)};
    }"""
    return {name: np.frombuffer(base64.b64decode(text), np.uint8) for name, text in page.ask(script).items()}


@pytest.mark.data
def test_the_real_chair_is_what_render_shows(browser: Browser, folder: Path, chair: Path) -> None:
    made = exact_page(folder / "chair.html", build_field(load(chair / "chair_sh9_128.npz", N3Tree)))
    with browser.opened(made.path) as page:
        page.wait_until_ready()
        assert_same_pictures(page, made)


# -- what people do --------------------------------------------------------------------------------------------
def test_a_page_is_silent_and_draws_nothing_while_nothing_changes(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.wait_until_still()
        drawn = page.ask("nerfbake.frames")
        page.page.wait_for_timeout(700)
        assert page.ask("nerfbake.frames") == drawn
        assert page.log == []
        assert page.ask("nerfbake.data") is None
        assert page.ask("document.getElementById('data')") is None
        # What stands on the screen at rest is refined: the mean of four rays a pixel, and not empty.
        assert page.page.is_hidden("#note")


def test_keys_pointers_and_the_address_move_the_camera(browser: Browser, exact: Made) -> None:
    # Wide enough for the buttons to leave the middle free.
    with browser.opened(exact.path, viewport={"width": 400, "height": 300}) as page:
        page.wait_until_ready()
        opened = page.ask("nerfbake.camera.pose")
        assert page.ask("location.hash") == ""
        for act in (
            lambda: page.page.keyboard.press("ArrowLeft"),
            lambda: page.page.keyboard.press("Shift+ArrowUp"),
            lambda: page.page.keyboard.press("+"),
            lambda: page.page.mouse.wheel(0, 200),
            lambda: drag(page, "left"),
            lambda: drag(page, "right"),
            lambda: page.page.keyboard.press("r"),
            lambda: page.page.mouse.dblclick(200, 125),
        ):
            before = page.ask("JSON.stringify(nerfbake.camera.pose)")
            act()
            page.wait_for(f"JSON.stringify(nerfbake.camera.pose) !== {json.dumps(before)}")
        moved, drawn = page.ask("nerfbake.camera.pose"), page.ask("nerfbake.capture()")
        assert drawn["frames"][0]["transform_matrix"] == moved
        page.wait_for("location.hash === nerfbake.camera.hash")
        address = page.ask("location.hash")
        page.page.keyboard.press("r")
        assert page.ask("nerfbake.camera.pose") == opened
        assert page.log == []
    with browser.opened(exact.path, hash=address) as page:
        page.wait_until_ready()
        np.testing.assert_allclose(page.ask("nerfbake.camera.pose"), moved, atol=1e-7)


def drag(page: Seen, button: str) -> None:
    mouse = page.page.mouse
    mouse.move(200, 120)
    mouse.down(button=button)
    mouse.move(240, 130)
    mouse.up(button=button)


def test_the_copied_camera_renders_the_same_picture(browser: Browser, exact: Made, tmp_path: Path) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.page.keyboard.press("ArrowUp")
        (tmp_path / "c.json").write_text(json.dumps(page.ask("nerfbake.capture()")))
        [camera] = load(tmp_path / "c.json", Cameras).cameras
        assert (camera.width, camera.height) == (EDGE, EDGE)
        wanted = render_field(exact.field, camera).pixels.astype(np.float64)
        text = page.ask("textOf(nerfbake.picture.pixels(nerfbake.lens, 200, 200, {background: [1, 1, 1]}))")
        shown = np.frombuffer(base64.b64decode(text), np.uint8).reshape(EDGE, EDGE, 4)[..., :3]
        assert ((shown - wanted) ** 2).mean() / 255**2 <= 10**-8.0
        pose = page.ask("nerfbake.camera.pose")
        np.testing.assert_allclose(camera.pose, pose, atol=1e-12)


def test_a_scene_turns_until_it_is_touched(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, reduced_motion="no-preference", viewport={"width": 40, "height": 40}) as page:
        page.wait_until_ready()
        assert page.ask("nerfbake.facts.turns")
        page.wait_for("nerfbake.angle > 0")
        page.page.keyboard.press("ArrowLeft")
        assert not page.ask("nerfbake.turning")


def test_graphics_that_are_lost_come_back(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path) as page:
        page.wait_until_ready()
        page.ask("window.lose = nerfbake.picture.gl.getExtension('WEBGL_lose_context'); lose.loseContext()")
        page.wait_for("nerfbake.state === 'lost'")
        assert "taken away" in page.status
        page.ask("lose.restoreContext()")
        page.wait_until_ready()
        assert_same_pictures(page, exact)


def test_a_phone_shows_every_button_in_dark_colours(browser: Browser, exact: Made) -> None:
    size = {"width": 320, "height": 480}
    with browser.opened(exact.path, viewport=size, color_scheme="dark", has_touch=True) as page:
        page.wait_until_ready()
        for button in page.page.query_selector_all("#tools button, #tools select"):
            box = button.bounding_box()
            assert box["x"] >= 0
            assert box["x"] + box["width"] <= 320
            assert min(box["width"], box["height"]) >= 43.9
        assert page.ask("getComputedStyle(document.body).backgroundColor") == "rgb(21, 24, 28)"
        assert page.page.get_attribute("#canvas", "aria-label").startswith("A sample: ")


# -- what goes wrong -------------------------------------------------------------------------------------------
def test_without_webgl_there_is_a_sentence_and_a_picture(browser: Browser, exact: Made) -> None:
    with browser.opened(exact.path, init="HTMLCanvasElement.prototype.getContext = () => null") as page:
        page.wait_for("nerfbake.state === 'failed'")
        assert page.status.startswith("Looking around needs WebGL 2, which this browser does not offer.")
        assert page.ask("document.getElementById('cover').naturalWidth") == 40
        assert page.log == []


@pytest.mark.parametrize(("share", "said"), [(0.99, "characters of its data are there"), (0.4, "is not complete")])
def test_a_truncated_page_says_so(browser: Browser, exact: Made, tmp_path: Path, share: float, said: str) -> None:
    whole = exact.path.read_bytes()
    at = int(share * len(whole)) if share > 0.5 else whole.index(b"class Viewer")
    (tmp_path / "cut.html").write_bytes(whole[:at])
    with browser.opened(tmp_path / "cut.html") as page:
        page.wait_for(f"document.getElementById('status').textContent.includes({json.dumps(said)})")
        assert page.log == []


def test_a_hostile_title_is_text(browser: Browser, exact: Made, tmp_path: Path) -> None:
    save(tmp_path / "hostile.html", view_of(exact.arrays, exact.field, HOSTILE))
    with browser.opened(tmp_path / "hostile.html") as page:
        page.wait_until_ready()
        assert page.log == []
        assert "<script>alert(2)</script>{{data}}&amp;" in page.page.inner_text("h1")
        assert page.ask("document.querySelectorAll('h1 *, img').length") == 1
        # Nothing but its own script runs, even where somebody gets one in.
        page.ask(
            "document.body.append(Object.assign(document.createElement('script'), {textContent: 'window.in = 1'}))"
        )
        assert page.ask("window.in") is None
